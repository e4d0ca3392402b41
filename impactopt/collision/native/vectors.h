/* SIMD vectors of the machine's width, and sizes of arrays padded to them. Compilers split wider vectors badly. */
#include <math.h>
#include <string.h>

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double vec __attribute__((vector_size(8 * LANES), may_alias));
typedef long long bits __attribute__((vector_size(8 * LANES), may_alias));
#define VECTORS(n) (((n) + LANES - 1) / LANES)
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)
#ifdef __OPTIMIZE__
#define INLINE static inline __attribute__((always_inline))
#else /* code that is compiled in a hurry: copies would take time, and gain nothing */
#define INLINE static inline
#endif

/* vectors of the joints, then the hand */
#define V VECTORS(N + 1)
/* vectors of joints, hand, and the other velocities */
#define VF VECTORS(NV + 1)
/* vectors of the constraints */
#define VC AT_LEAST_1(VECTORS(C))
#define C1 AT_LEAST_1(C)
#define N1 AT_LEAST_1(N)
#define NZ1 AT_LEAST_1(NZ)

/* indices of entries in matrices with such rows */
#define OF_ROOT(r, c) ((r) * VF * LANES + (c))
#define OF_HELD(r, c) ((r) * VC * LANES + (c))

#define FOR(i, n) for (int i = 0; i < (n); i++)
#define SIGN_BIT ((bits){} + (long long)0x8000000000000000ULL)

INLINE vec choose(bits condition, vec yes, vec no) {
  return (vec)(((bits)yes & condition) | ((bits)no & ~condition));
}
INLINE vec either(int condition, vec yes, vec no) {
  if (condition) return yes;
  return no;
}
#ifdef __clang__
#define SHUFFLED(x, ...) __builtin_shufflevector(x, x, __VA_ARGS__)
#else
#define SHUFFLED(x, ...) __builtin_shuffle(x, (bits){__VA_ARGS__})
#endif
#if LANES == 8
#define LANE_NUMBERS 0, 1, 2, 3, 4, 5, 6, 7
#elif LANES == 4
#define LANE_NUMBERS 0, 1, 2, 3
#else
#define LANE_NUMBERS 0, 1
#endif
INLINE double sum(vec x) {
#if LANES == 8
  x += SHUFFLED(x, 4, 5, 6, 7, 0, 1, 2, 3);
  x += SHUFFLED(x, 2, 3, 0, 1, 6, 7, 4, 5);
#elif LANES == 4
  x += SHUFFLED(x, 2, 3, 0, 1);
#endif
  return x[0] + x[1];
}
INLINE double dot(const vec *a, const vec *b, int count) {
  vec s = a[0] * b[0];
  for (int r = 1; r < count; r++) s += a[r] * b[r];
  return sum(s);
}
INLINE int any(bits x) {
#if defined(__AVX512DQ__)
  return __builtin_ia32_cvtq2mask512(x) != 0;
#elif LANES == 4
  return __builtin_ia32_movmskpd256((vec)x) != 0;
#else
  long long found = 0;
  FOR(i, LANES) found |= x[i];
  return found != 0;
#endif
}
/* Transposes a square matrix, one row per vector: halves change places, then halves of these. */
INLINE void transpose(vec *x) {
#ifdef __clang__
  vec y[LANES];
  FOR(i, LANES) FOR(k, LANES) y[i][k] = x[k][i];
  FOR(i, LANES) x[i] = y[i];
#else
  const bits lane = {LANE_NUMBERS};
#pragma GCC unroll 8
  for (int h = LANES / 2; h; h /= 2) {
    const bits low = lane + ((lane & h) != 0 & (LANES - h)), high = low + h;
    vec y[LANES];
#pragma GCC unroll 8
    FOR(i, LANES) y[i] = i & h ? __builtin_shuffle(x[i - h], x[i], high) : __builtin_shuffle(x[i], x[i + h], low);
#pragma GCC unroll 8
    FOR(i, LANES) x[i] = y[i];
  }
#endif
}
/* Clears the lanes of vector V - 1 beyond the hand, where `root` has other velocities. */
#define to_hand(x) ((vec)((bits)(x) & ((bits){LANE_NUMBERS} <= (long long)(N % LANES))))
/* Hides a pointer's origin from the compiler. Where it knows that the data behind have not changed, it keeps hundreds
   of vectors for the next call: copies on the stack, which cost more than loading the data again. */
#define AFRESH(pointer) __asm__ volatile("" : "+r"(pointer))
/* Copies n numbers into the first lanes, and `rest` into the others. */
INLINE void pad(vec *to, int count, const double *from, int n, double rest) {
  double *x = (double *)to;
  FOR(i, n) x[i] = from ? from[i] : 0.0;
  for (int i = n; i < count * LANES; i++) x[i] = rest;
}
