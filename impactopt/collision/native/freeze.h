/* Model frozen at one instant (steps 1b and 2b). Symbols as in collision/frozen.py.

   With roots W of joints and hand in one matrix B, and Z = R^-1 W_c' B,  Q = B' B - Z' Z = [A s; s' m]. Q times
   (integral of the torque, minus the impulse) gives the joints' velocity and the hand's speed. With friction at the
   contact, Q_point are further columns for the striking point's three coordinates, and m_point is the block between
   these. */

typedef struct {
  vec root[NV][VF];     /* D^-1/2 L^-T; columns: joints, hand, the other velocities */
  vec held[NV][VC];     /* W_c */
  vec Z[C1][V];
  vec Q[N + 1][V];
  vec drift[V];         /* d, e */
  vec wrench[N + 1][VC]; /* columns of L_tau, L_f */
  vec L_0[VC];
  double R[C1][C1];     /* with the reciprocal of its diagonal */
  double held_push[C1]; /* R^-1 times minus the acceleration of the constrained frames if they were free */
  double bias_root[NV];
  double drift_velocity[NV];
  double hand_speed, approach_speed; /* of the hand, and relative to the target, along the normal */
  double soles[AT_LEAST_1(3 * SOLES)];
  double unmodelled[6];
#if SLIDES
  double point_root[3][NV], point_held[3][C1], m_point[3][3], point_velocity[3], e_point[3];
  vec Q_point[3][V], L_point[3][VC];
#endif
  int ill_conditioned;  /* a relative pivot, or the hand's relative mobility, is below LEAST_PIVOT */
} Frozen;

/* x := R^-1 x and x := R^-T x; T is double, or vec for several right-hand sides */
#define SOLVE(F, x, T) \
  FOR(c, C) { T s_ = (x)[c]; FOR(k, c) s_ -= (F)->R[c][k] * (x)[k]; (x)[c] = s_ * (F)->R[c][c]; }
#define SOLVE_TRANSPOSED(F, x, T) \
  for (int c = C - 1; c >= 0; c--) { \
    T s_ = (x)[c]; for (int k = c + 1; k < C; k++) s_ -= (F)->R[k][c] * (x)[k]; (x)[c] = s_ * (F)->R[c][c]; }

static void evaluate_tree(const double *q, const double *v, const double *normal, Frozen *F) {
  double root[ROOT_NONZEROS], held[AT_LEAST_1(HELD_NONZEROS)];
  const double *in[] = {q, v, normal};
  double *out[] = {
    root, held, &F->hand_speed,
#if GROUND
    F->soles,
#if !BIAS
    F->unmodelled,
#endif
#endif
#if SLIDES
    F->point_root[0], F->point_velocity,
#endif
  };
  memset(F->unmodelled, 0, sizeof F->unmodelled);
  tree(in, out, 0, 0, 0);
  memset(F->root, 0, sizeof F->root);
  memset(F->held, 0, sizeof F->held);
  double *to = (double *)F->root;
  FOR(i, ROOT_NONZEROS) to[ROOT_AT[i]] = root[i];
  to = (double *)F->held;
  FOR(i, HELD_NONZEROS) to[HELD_AT[i]] = held[i];
}

/* Cholesky factor of the Delassus matrix, and Z. Row by row as U = D L' of G = L D L': so each row waits for a
   division of the one before, and not for a square root. */
static void factor_constraints(Frozen *F) {
  vec U[C1][VC];
  double inverse[C1];
  F->ill_conditioned = 0;
  FOR(c, C) {
    vec u[VC] = {0}, z[V] = {0};
    for (int k = HELD_ROWS[c]; k < HELD_ROWS[c + 1]; k++) {
      const int r = HELD_ROW[k];
      const double w = ((double *)F->held[r])[c];
      FOR(i, VC) u[i] += w * F->held[r][i];
      FOR(i, V) z[i] += w * F->root[r][i];
    }
    const double whole = ((double *)u)[c] + GAMMA[c];
    FOR(k, c) {
      const double l = ((double *)U[k])[c] * inverse[k];
      FOR(i, VC) u[i] -= l * U[k][i];
      FOR(i, V) z[i] -= l * F->Z[k][i];
    }
    FOR(i, VC) U[c][i] = u[i];
    FOR(i, V) F->Z[c][i] = z[i];
    const double pivot = ((double *)U[c])[c] + GAMMA[c];
    F->ill_conditioned |= !(pivot > LEAST_PIVOT * whole);
    inverse[c] = 1.0 / pivot;
  }
  FOR(c, C) {
    const double scale = F->R[c][c] = sqrt(inverse[c]);
    for (int k = c + 1; k < C; k++) F->R[k][c] = ((double *)U[c])[k] * scale;
    FOR(i, V) F->Z[c][i] *= scale;
    F->Z[c][V - 1] = to_hand(F->Z[c][V - 1]);
  }
}

/* Rows begin..end of Q, from vector `first` on. */
INLINE void rows_of_inertia(Frozen *F, int first, int begin, int end) {
  for (int j = begin; j < end; j++) {
    vec s[V] = {0};
    for (int k = ROOT_ROWS[j]; k < ROOT_ROWS[j + 1]; k++) {
      const int r = ROOT_ROW[k];
      const double w = ((double *)F->root[r])[j];
      for (int i = first; i < V; i++) s[i] += w * F->root[r][i];
    }
    FOR(c, C) {
      const double z = ((double *)F->Z[c])[j];
      for (int i = first; i < V; i++) s[i] -= z * F->Z[c][i];
    }
    s[V - 1] = to_hand(s[V - 1]);
    for (int i = first; i < V; i++) F->Q[j][i] = s[i];
  }
}

/* Q is symmetric: its upper triangle in whole vectors, then the mirror image. */
static void inverse_inertia(Frozen *F) {
#define ROWS_FROM(b, count) \
  if (V > b) rows_of_inertia(F, b, (b) * LANES, V > (b) + count ? ((b) + count) * LANES : N + 1);
  ROWS_FROM(0, 1) ROWS_FROM(1, 1) ROWS_FROM(2, 1) ROWS_FROM(3, 1)
  ROWS_FROM(4, 1) ROWS_FROM(5, 1) ROWS_FROM(6, 1) ROWS_FROM(7, V)
  for (int b = 1; b < V; b++) FOR(a, b) {
    vec x[LANES];
    FOR(i, LANES) x[i] = F->Q[a * LANES + i][b];
    transpose(x);
    FOR(i, LANES) if (b * LANES + i <= N) F->Q[b * LANES + i][a] = x[i];
  }
}

/* Q_point and m_point, from the striking point's columns of W and Z. */
static void inertia_at_point(Frozen *F) {
#if SLIDES
  FOR(k, 3) {
    double *z = F->point_held[k];
    FOR(c, C) z[c] = 0.0;
    FOR(r, NV) FOR(c, C) z[c] += F->point_root[k][r] * ((double *)F->held[r])[c];
    SOLVE(F, z, double)
    vec s[V] = {0};
    FOR(r, NV) FOR(i, V) s[i] += F->point_root[k][r] * F->root[r][i];
    FOR(c, C) FOR(i, V) s[i] -= z[c] * F->Z[c][i];
    s[V - 1] = to_hand(s[V - 1]);
    FOR(i, V) F->Q_point[k][i] = s[i];
  }
  FOR(k, 3) FOR(l, 3) {
    double m = 0.0;
    FOR(r, NV) m += F->point_root[k][r] * F->point_root[l][r];
    FOR(c, C) m -= F->point_held[k][c] * F->point_held[l][c];
    F->m_point[k][l] = m;
  }
#endif
}

/* W x for x in `root`'s order of columns, and W' x. */
static void times_root(const Frozen *F, const vec *x, double *out) {
  FOR(r, NV) out[r] = dot(F->root[r], x, VF);
}
static void times_root_transposed(const Frozen *F, const double *x, double *out) {
  vec s[VF] = {0};
  FOR(r, NV) FOR(i, VF) s[i] += x[r] * F->root[r][i];
  FOR(i, NV) out[i] = ((double *)s)[COLUMN(i)];
}

static void plastic_velocity(const double *v, double target_inverse_mass, Frozen *F) {
  memcpy(F->drift_velocity, v, NV * sizeof(double));
#if BIAS || JDOT
  /* The change of velocity by a plastic touch: P j' is in Q for the joints. The other velocities come first in v, and
   their roots are triangular. */
  double y[C1], inner[AT_LEAST_1(NV - N)];
  FOR(c, C) y[c] = ((double *)F->Z[c])[N];
  SOLVE_TRANSPOSED(F, y, double)
  vec held_y[VC];
  pad(held_y, VC, y, C, 0.0);
  const double *of_hand = (const double *)F->Q[N];
  const double impulse = (F->approach_speed < 0.0 ? 0.0 : F->approach_speed) / (of_hand[N] + target_inverse_mass);
  FOR(r, NV - N) inner[r] = ((double *)F->root[r])[N] - dot(F->held[r], held_y, VC);
  FOR(i, NV - N) FOR(r, i + 1) F->drift_velocity[i] -= ((double *)F->root[r])[COLUMN(i)] * inner[r] * impulse;
  FOR(j, N) F->drift_velocity[NV - N + j] -= of_hand[j] * impulse;
#endif
}

static void drifts(const double *q, const double *normal, Frozen *F) {
  double held_push[C1] = {0};
  memset(F->bias_root, 0, sizeof F->bias_root);
  FOR(i, V) F->drift[i] = (vec){0};
#if SLIDES
  memset(F->e_point, 0, sizeof F->e_point);
#endif
#if BIAS || JDOT
  double bias[NV], of_hand = 0.0, of_held[C1];
  const double *in[] = {q, F->drift_velocity, normal};
  double *out[] = {
#if BIAS
    bias,
#endif
#if JDOT
    &of_hand, of_held,
#if SLIDES
    F->e_point
#endif
#endif
  };
  drift(in, out, 0, 0, 0);
#if BIAS
  vec x[VF] = {0}, by_constraints[VC] = {0}, sum_of[V] = {0};
  FOR(i, NV) ((double *)x)[COLUMN(i)] = bias[i];
  FOR(r, NV) {
    const double b = F->bias_root[r] = dot(F->root[r], x, VF);
    FOR(i, V) sum_of[i] -= b * F->root[r][i];
    FOR(i, VC) by_constraints[i] += b * F->held[r][i];
  }
  FOR(i, V) F->drift[i] = sum_of[i];
  FOR(c, C) held_push[c] = ((double *)by_constraints)[c];
#endif
#if JDOT
  FOR(c, C) held_push[c] -= of_held[c];
#endif
  SOLVE(F, held_push, double)
  memcpy(F->held_push, held_push, sizeof held_push);
  FOR(c, C) FOR(i, V) F->drift[i] += held_push[c] * F->Z[c][i];
  for (int i = N + 1; i < V * LANES; i++) ((double *)F->drift)[i] = 0.0;
  ((double *)F->drift)[N] += of_hand;
#if SLIDES
  FOR(k, 3) {
    FOR(r, NV) F->e_point[k] -= F->bias_root[r] * F->point_root[k][r];
    FOR(c, C) F->e_point[k] += F->held_push[c] * F->point_held[k][c];
  }
#endif
#endif
#if WRENCHES
  SOLVE_TRANSPOSED(F, held_push, double)
  pad(F->L_0, VC, held_push, C, 0.0);
#endif
}

/* L_tau and L_f: -R^-T Z, by columns */
static void wrenches(Frozen *F) {
#if WRENCHES
  vec y[C1][V];
  memset(F->wrench, 0, sizeof F->wrench);
  memcpy(y, F->Z, sizeof y);
  for (int c = C - 1; c >= 0; c--) {
    vec s[V];
    FOR(i, V) s[i] = y[c][i];
    for (int k = c + 1; k < C; k++) FOR(i, V) s[i] -= F->R[k][c] * y[k][i];
    FOR(i, V) y[c][i] = s[i] * F->R[c][c];
  }
  FOR(j, N + 1) FOR(c, C) ((double *)F->wrench[j])[c] = -((double *)y[c])[j];
#if SLIDES
  FOR(k, 3) {
    double x[C1];
    memcpy(x, F->point_held[k], sizeof x);
    SOLVE_TRANSPOSED(F, x, double)
    pad(F->L_point[k], VC, x, C, 0.0);
    FOR(i, VC) F->L_point[k][i] = -F->L_point[k][i];
  }
#endif
#endif
}

/* NaN where rounding dominates; see `check_frozen` in collision/checks.py. */
static void nan_if_ill_conditioned(Frozen *F) {
  double whole = 0.0;
  FOR(r, NV) whole += ((double *)F->root[r])[N] * ((double *)F->root[r])[N];
  const double left = ((double *)F->Q[N])[N];
  if (C) F->ill_conditioned |= !(left > LEAST_PIVOT * whole) && left != 0.0;
  if (!F->ill_conditioned) return;
  F->hand_speed = NAN;
  FOR(j, N + 1) FOR(i, V) F->Q[j][i] = (vec){0} + NAN;
}

static void freeze(const double *q, const double *v, const double *normal, double target_inverse_mass,
                   double target_speed, Frozen *F) {
  evaluate_tree(q, v, normal, F);
  F->approach_speed = F->hand_speed - target_speed;
  factor_constraints(F);
  inverse_inertia(F);
  inertia_at_point(F);
  nan_if_ill_conditioned(F);
  plastic_velocity(v, target_inverse_mass, F);
  drifts(q, normal, F);
  wrenches(F);
}

/* Wrenches on all constrained frames for a torque, a force at the hand and its friction (3); weight: of L_0. */
static void wrench_of(const Frozen *F, const double *torque, double force, const double *sliding, double weight,
                      vec *out) {
  FOR(i, VC) out[i] = weight * F->L_0[i] - force * F->wrench[N][i];
#if SLIDES
  FOR(k, 3) FOR(i, VC) out[i] -= sliding[k] * F->L_point[k][i];
#endif
  FOR(j, N) FOR(i, VC) out[i] += torque[j] * F->wrench[j][i];
}

/* Change of v (nv) from time integrals of torque, force and friction; or of the position, from second integrals. */
static void velocity_change(const Frozen *F, const vec *torque, double impulse, const double *sliding, double time,
                            double *out) {
  vec w[VC], x[VF] = {0};
  double inner[NV];
  wrench_of(F, (const double *)torque, impulse, sliding, time, w);
  FOR(i, N) ((double *)x)[i] = ((const double *)torque)[i];
  ((double *)x)[N] = -impulse;
  times_root(F, x, inner);
  FOR(r, NV) inner[r] += dot(F->held[r], w, VC) - F->bias_root[r] * time;
#if SLIDES
  FOR(r, NV) FOR(k, 3) inner[r] -= F->point_root[k][r] * sliding[k];
#endif
  times_root_transposed(F, inner, out);
}
