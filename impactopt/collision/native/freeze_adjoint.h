/* From derivatives by the frozen model to those by q and v; see freeze.h. With Y = W_c' B, P = G^-1 Y and
   p = R^-T held_push, G = R R' the Delassus matrix, Q = B' B - Y' P, and the drifts are
   Y' p - B' (root of bias). */

typedef struct {
  vec root[NV][VF], held[NV][VC], Y[C1][V], G[C1][VC];
  double q[NQ], v[NV];
} FreezeAdjoint;

INLINE void add_to(vec *x, double factor, const vec *y, int count) { FOR(i, count) x[i] += factor * y[i]; }

/* From the order of v to that of `root`'s columns. */
static void to_columns(const double *x, vec *out) {
  FOR(i, VF) out[i] = (vec){0};
  FOR(i, NV) ((double *)out)[COLUMN(i)] = x[i];
}

#if BIAS || JDOT
/* Adjoint of the drifts, and of the velocity that they are evaluated at. */
static void drifts_adjoint(const double *q, const double *normal, double target_inverse_mass, const Frozen *F,
                           FrozenAdjoint *all, FreezeAdjoint *b) {
  double bias[NV] = {0}, of_hand, of_held[C1], p[C1] = {0}, by_push[C1] = {0}, by_bias_root[NV], by_bias[NV] = {0};
  double by_hand = ((double *)all->drift)[N], by_held[C1], by_q[NQ], by_v[NV];
  const double *in[] = {q, F->drift_velocity, normal,
#if BIAS
    by_bias,
#endif
#if JDOT
    &by_hand, by_held,
#endif
  };
  double *out[] = {
#if BIAS
    bias,
#endif
#if JDOT
    &of_hand, of_held
#endif
  };
  FOR(c, C) p[c] = F->held_push[c], by_push[c] = dot(F->Z[c], all->drift, V);
  SOLVE_TRANSPOSED(F, p, double)
  SOLVE_TRANSPOSED(F, by_push, double)
  FOR(c, C) {
    add_to(b->Y[c], p[c], all->drift, V);
    FOR(k, C) ((double *)b->G[c])[k] -= by_push[c] * p[k];
    by_held[c] = -by_push[c];
  }
#if BIAS
  drift(in, out, 0, 0, 0);
  vec x[VF], by_constraints[VC];
  pad(by_constraints, VC, by_push, C, 0.0);
  to_columns(bias, x);
  FOR(r, NV) {
    by_bias_root[r] = dot(F->held[r], by_constraints, VC) - dot(F->root[r], all->drift, V);
    add_to(b->held[r], F->bias_root[r], by_constraints, VC);
    add_to(b->root[r], -F->bias_root[r], all->drift, V);
    add_to(b->root[r], by_bias_root[r], x, VF);
  }
  times_root_transposed(F, by_bias_root, by_bias);
#endif
  double *back[] = {by_q, by_v};
  drift_adjoint(in, back, 0, 0, 0);
  FOR(i, NQ) b->q[i] += by_q[i];
  FOR(i, NV) b->v[i] += by_v[i];

  /* the velocity after a plastic touch */
  double y[C1] = {0}, by_y[C1] = {0}, inner[NV], change[NV];
  vec by_change[VF], held_y[VC];
  FOR(c, C) y[c] = ((double *)F->Z[c])[N];
  SOLVE_TRANSPOSED(F, y, double)
  pad(held_y, VC, y, C, 0.0);
  FOR(r, NV) inner[r] = ((double *)F->root[r])[N] - dot(F->held[r], held_y, VC);
  times_root_transposed(F, inner, change);
  const double mobility = ((double *)F->Q[N])[N] + target_inverse_mass;
  const double impulse = (F->approach_speed >= 0.0 ? F->approach_speed : 0.0) / mobility;
  double by_impulse = 0.0, by_inner[NV];
  FOR(i, NV) by_impulse -= change[i] * by_v[i], by_v[i] *= -impulse;
  if (F->approach_speed >= 0.0) all->hand_speed += by_impulse / mobility;
  ((double *)all->Q[N])[N] -= by_impulse * impulse / mobility;
  to_columns(by_v, by_change);
  times_root(F, by_change, by_inner);
  FOR(r, NV) {
    add_to(b->root[r], inner[r], by_change, VF);
    ((double *)b->root[r])[N] += by_inner[r];
    add_to(b->held[r], -by_inner[r], held_y, VC);
    FOR(c, C) by_y[c] -= ((double *)F->held[r])[c] * by_inner[r];
  }
  SOLVE(F, by_y, double)
  SOLVE_TRANSPOSED(F, by_y, double)
  FOR(c, C) {
    ((double *)b->Y[c])[N] += by_y[c];
    add_to(b->G[c], -by_y[c], held_y, VC);
  }
}
#endif

/* Sets by_q and by_v (nv), by_q in v's basis; overwrites `all`. */
static void freeze_adjoint(const double *q, const double *v, const double *normal, double target_inverse_mass,
                           const Frozen *F, FrozenAdjoint *all, FreezeAdjoint *b, double *by_q, double *by_v) {
  memset(b, 0, sizeof *b);
#if BIAS || JDOT
  for (int i = N + 1; i < V * LANES; i++) ((double *)all->drift)[i] = 0.0;
  drifts_adjoint(q, normal, target_inverse_mass, F, all, b);
#endif

  /* Q, symmetric */
  double(*by)[V * LANES] = (double(*)[V * LANES])all->Q;
  FOR(i, N + 1) FOR(k, i + 1) by[i][k] = by[k][i] = by[i][k] + by[k][i];
  FOR(i, N + 1) for (int k = N + 1; k < V * LANES; k++) by[i][k] = 0.0;
  vec P[C1][V];
  memcpy(P, F->Z, sizeof P);
  FOR(i, V) for (int c = C - 1; c >= 0; c--) {
    vec s = P[c][i];
    for (int k = c + 1; k < C; k++) s -= F->R[k][c] * P[k][i];
    P[c][i] = s * F->R[c][c];
  }
  FOR(c, C) {
    vec s[V] = {0};
    FOR(j, N + 1) FOR(i, V) s[i] += ((double *)P[c])[j] * all->Q[j][i];
    FOR(i, V) b->Y[c][i] -= s[i];
    FOR(k, C) ((double *)b->G[c])[k] += 0.5 * dot(s, P[k], V);
  }
  FOR(c, C) FOR(k, c + 1) {
    double *a = (double *)b->G[c] + k, *t = (double *)b->G[k] + c;
    *a = *t = *a + *t;
  }
  /* Y = W_c' B, G = W_c' W_c + Gamma, B' B */
  FOR(r, NV) {
    const double *w = (const double *)F->held[r];
    FOR(c, C) {
      if (w[c] != 0.0) add_to(b->root[r], w[c], b->Y[c], V);
      if (w[c] != 0.0) add_to(b->held[r], w[c], b->G[c], VC);
      ((double *)b->held[r])[c] += dot(b->Y[c], F->root[r], V);
    }
    FOR(j, N + 1) {
      const double x = ((const double *)F->root[r])[j];
      if (x != 0.0) add_to(b->root[r], x, all->Q[j], V);
    }
  }

  double root[ROOT_NONZEROS], held[AT_LEAST_1(HELD_NONZEROS)], q_[NQ], v_[NV];
  FOR(i, ROOT_NONZEROS) root[i] = ((double *)b->root)[ROOT_AT[i]];
  FOR(i, HELD_NONZEROS) held[i] = ((double *)b->held)[HELD_AT[i]];
  const double *in[] = {q, v, normal, root, held, &all->hand_speed};
  double *out[] = {q_, v_};
  tree_adjoint(in, out, 0, 0, 0);
  FOR(i, NQ) b->q[i] += q_[i];
  FOR(i, NV) by_v[i] = b->v[i] + v_[i];
  const double *to_tangent[] = {q, b->q};
  to_velocity_basis(to_tangent, &by_q, 0, 0, 0);
}
