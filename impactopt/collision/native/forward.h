/* Tangents: what moves with q, v and the feed-forward torque, a direction a lane. The directions of q, in v's basis, come
   first, then those of v, then those of the torque. What is frozen of the inertia moves with q alone, and with the
   torque nothing that is frozen. Symbols as in freeze.h and implicit.h. */

enum { BY_Q, BY_V, BY_FEEDFORWARD };
#define KINDS (2 + FEEDFORWARD)
#define SEEDS(kind) ((kind) == BY_FEEDFORWARD ? N : NV)
#define FIRST_OF(kind) ((kind) * NV)
/* vectors with directions of q, of q or v, and all: one after the other, so that what a step needs of it is in the nearest
   cache. Products have as many rows at once as registers hold */
#define VECTORS_OF_Q VECTORS(NV)
#define VECTORS_OF_V VECTORS(2 * NV)
#define ALL_VECTORS VECTORS(2 * NV + FEEDFORWARD * N)
#define HIGH (V % 2 ? LANES : 2 * LANES)
/* joints and hand, and what fills the last vector of them; columns are odd in number, so that the rows of one are not all
   kept in the same place of a cache */
#define ROWS_OF_V (V * LANES)
#define COLUMNS_OF_V ((N + 1) | 1)

/* rows of wrenches that columns ask for, SIX at once: of what is held, and of the ground */
#define SIX 6
#if defined(OUT_sole_wrench) || defined(OUT_hand_wrench)
#define HELD_ASKED 1
#else
#define HELD_ASKED 0
#endif
#if defined(OUT_ground_wrench) || defined(OUT_zmp)
#define GROUND_ASKED 1
#else
#define GROUND_ASKED 0
#endif
#define WRENCHES_ASKED AT_LEAST_1(HELD_ASKED * C / SIX + GROUND_ASKED)

typedef struct {
  vec Q[VECTORS_OF_Q][ROWS_OF_V][COLUMNS_OF_V];
  vec drift[ALL_VECTORS][ROWS_OF_V], hand_speed[ALL_VECTORS];
  /* wrenches are begin - by (torques, minus the force), by a number that moves with q alone */
  vec wrench_begin[ALL_VECTORS][WRENCHES_ASKED][SIX], wrench_by[VECTORS_OF_Q][WRENCHES_ASKED][N + 1][SIX];
  double by[WRENCHES_ASKED][N + 1][SIX];
} FrozenTangent;

/* out = from + A x, or without `from` A x: A has a row of vectors for each of `count` numbers x */
INLINE void add_product(const vec (*A)[V], int count, const vec *x, const vec *from, vec *out) {
  for (int i = 0; i < ROWS_OF_V; i += HIGH) {
    vec s[HIGH];
    FOR(a, HIGH) s[a] = (vec){0};
    if (from) FOR(a, HIGH) s[a] = from[i + a];
    FOR(j, count) FOR(a, HIGH) s[a] += ((const double *)A[j])[i + a] * x[j];
    FOR(a, HIGH) out[i + a] = s[a];
  }
}

/* the k-th vector of directions += y in one direction, if that is in it */
INLINE void add_to_direction(vec *x, int k, int direction, double y) {
  if (direction / LANES == k) ((double *)x)[direction % LANES] += y;
}
