/* Tangents by q, v and the feed-forward torque, one direction per lane. Directions of q, in v's basis, come first, then
   those of v, then those of the torque. The frozen inertia depends on q alone, and nothing frozen on the torque.
   Symbols as in freeze.h and implicit.h. */

enum { BY_Q, BY_V, BY_FEEDFORWARD };
#define KINDS (2 + FEEDFORWARD)
#define SEEDS(kind) ((kind) == BY_FEEDFORWARD ? N : NV)
#define FIRST_OF(kind) ((kind) * NV)
/* Vectors with directions of q, of q or v, and all. They are taken one after the other, so that the data of a step stay
   in the nearest cache. Products take as many rows at once as registers hold. */
#define VECTORS_OF_Q VECTORS(NV)
#define VECTORS_OF_V VECTORS(2 * NV)
#define ALL_VECTORS VECTORS(2 * NV + FEEDFORWARD * N)
#define ROWS_AT_ONCE (V % 2 ? LANES : 2 * LANES)
/* Joints and hand, padded to whole vectors. The number of columns is odd: else all rows of a column would compete for
   the same lines of a cache. */
#define ROWS_OF_V (V * LANES)
#define COLUMNS_OF_V ((N + 1) | 1)

/* Wrenches that the histories need, of six entries each: of the constrained frames, and of the ground. */
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
  /* wrench = wrench_begin - by (torques, minus the force); `by` depends on q alone */
  vec wrench_begin[ALL_VECTORS][WRENCHES_ASKED][SIX], wrench_by[VECTORS_OF_Q][WRENCHES_ASKED][N + 1][SIX];
  double by[WRENCHES_ASKED][N + 1][SIX];
} FrozenTangent;

/* out = A x [+ from], A by columns. */
INLINE void add_product(const vec (*A)[V], int count, const vec *x, const vec *from, vec *out) {
  for (int i = 0; i < ROWS_OF_V; i += ROWS_AT_ONCE) {
    vec s[ROWS_AT_ONCE];
    FOR(a, ROWS_AT_ONCE) s[a] = (vec){0};
    if (from) FOR(a, ROWS_AT_ONCE) s[a] = from[i + a];
    FOR(j, count) FOR(a, ROWS_AT_ONCE) s[a] += ((const double *)A[j])[i + a] * x[j];
    FOR(a, ROWS_AT_ONCE) out[i + a] = s[a];
  }
}

/* Adds y in one direction, if the k-th vector has it. */
INLINE void add_to_direction(vec *x, int k, int direction, double y) {
  if (direction / LANES == k) ((double *)x)[direction % LANES] += y;
}
