/* Vectors of eight numbers, which the compiler maps to what the machine has, and arrays padded to them. */
#include <math.h>
#include <string.h>

typedef double vec __attribute__((vector_size(64), may_alias));
typedef long long bits __attribute__((vector_size(64), may_alias));
#define LANES 8
#define VECTORS(n) (((n) + LANES - 1) / LANES)
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)
#define INLINE static inline __attribute__((always_inline))

/* joints, then the hand */
#define V VECTORS(N + 1)
/* joints, hand, and the other velocities */
#define VF VECTORS(NV + 1)
/* rows of what is held */
#define VC AT_LEAST_1(VECTORS(C))
#define C1 AT_LEAST_1(C)
#define N1 AT_LEAST_1(N)
#define NZ1 AT_LEAST_1(NZ)

#define FOR(i, n) for (int i = 0; i < (n); i++)
#define SIGN_BIT ((bits){} + (long long)0x8000000000000000ULL)

INLINE vec choose(bits condition, vec yes, vec no) {
  return (vec)(((bits)yes & condition) | ((bits)no & ~condition));
}
#ifdef __clang__
#define SHUFFLED(x, ...) __builtin_shufflevector(x, x, __VA_ARGS__)
#else
#define SHUFFLED(x, ...) __builtin_shuffle(x, (bits){__VA_ARGS__})
#endif
INLINE double sum(vec x) {
  vec a = x + SHUFFLED(x, 4, 5, 6, 7, 0, 1, 2, 3);
  vec b = a + SHUFFLED(a, 2, 3, 0, 1, 6, 7, 4, 5);
  return b[0] + b[1];
}
INLINE double dot(const vec *a, const vec *b, int count) {
  vec s = a[0] * b[0];
  for (int r = 1; r < count; r++) s += a[r] * b[r];
  return sum(s);
}
INLINE int any(bits x) {
#ifdef __AVX512DQ__
  return __builtin_ia32_cvtq2mask512(x) != 0;
#else
  long long found = 0;
  FOR(i, LANES) found |= x[i];
  return found != 0;
#endif
}
/* numbers into the first lanes, and `rest` into the others */
INLINE void pad(vec *to, int count, const double *from, int n, double rest) {
  double *x = (double *)to;
  FOR(i, n) x[i] = from ? from[i] : 0.0;
  for (int i = n; i < count * LANES; i++) x[i] = rest;
}
