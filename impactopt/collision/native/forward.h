/* Tangents: what moves with q, v and the feed-forward torque, a direction a lane. The directions of q, in v's basis,
   are one kind, those of v another, and those of the torque, which moves nothing that is frozen, a third; what is
   frozen of the inertia moves with q alone. Symbols as in freeze.h and implicit.h. */

/* vectors of directions of a kind, VD; products take as many of them at once, WIDE, with as many rows, HIGH, as
   registers hold, so that some numbers of vectors are filled up */
#define NEEDED ((NV + LANES - 1) / LANES)
#if LANES == 8 && NEEDED % 5 == 0
#define WIDE 5
#elif LANES == 8 && NEEDED > 3 && NEEDED % 3
#define WIDE 4
#elif NEEDED % 3 == 0
#define WIDE 3
#else
#define WIDE (NEEDED > 1 ? 2 : 1)
#endif
#define VD ((NEEDED + WIDE - 1) / WIDE * WIDE)
#define HIGH (LANES < 4 ? LANES : 4)
/* joints and hand, and what fills the last vector of them */
#define ROWS_OF_V (V * LANES)
enum { BY_Q, BY_V, BY_FEEDFORWARD };
#define KINDS (2 + FEEDFORWARD)
#define SEEDS(kind) ((kind) == BY_FEEDFORWARD ? N : NV)

#define FOR_EACH(k) FOR(k, VD)

typedef struct {
  vec Q[ROWS_OF_V][N + 1][VD]; /* with q, as P and the soles */
  vec P[C1][N + 1][VD];
  vec soles[AT_LEAST_1(3 * SOLES)][VD];
  vec drift[KINDS][ROWS_OF_V][VD], L_0[KINDS][C1][VD], hand_speed[KINDS][VD], unmodelled[KINDS][6][VD];
} FrozenTangent;

/* out += A x: A has a row of vectors for each of `count` rows of x, which like those of `out` are `width` vectors */
INLINE void add_product(const vec (*A)[V], int count, const vec *x, int width, vec *out) {
  for (int i = 0; i < ROWS_OF_V; i += HIGH)
    for (int m = 0; m < width; m += WIDE) {
      vec s[HIGH][WIDE];
      FOR(a, HIGH) FOR(b, WIDE) s[a][b] = out[(i + a) * width + m + b];
      FOR(j, count) {
        const double *by = (const double *)A[j] + i;
        const vec *of = x + j * width + m;
        FOR(a, HIGH) FOR(b, WIDE) s[a][b] += by[a] * of[b];
      }
      FOR(a, HIGH) FOR(b, WIDE) out[(i + a) * width + m + b] = s[a][b];
    }
}

/* numbers, a direction each, from and to the lanes of a direction of v */
INLINE double *lane(vec *x, int direction) { return (double *)x + direction; }
