/* Steps 1b and 2b: what is computed once, at the moment of a freeze. Symbols as in collision/frozen.py.

   With roots W of joints and hand in one matrix B, and Z = R^-1 W_c' B,  Q = B' B - Z' Z = [A s; s' m]. A product
   of Q with (integral of the torque, minus the impulse) gives the joints' velocity and the hand's speed. */

typedef struct {
  vec root[NV][VF];     /* D^-1/2 L^-T; columns: joints, hand, the other velocities */
  vec held[NV][VC];     /* W_c */
  vec Z[C1][V];
  vec Q[N + 1][V];
  vec drift[V];         /* d, e */
  vec wrench[N + 1][VC]; /* columns of L_tau, L_f */
  vec L_0[VC];
  double R[C1][C1];     /* with the reciprocal of its diagonal */
  double push[C1];      /* R^-1 (acceleration of what is held if it were free) */
  double bias_root[NV];
  double drift_velocity[NV];
  double hand_speed;
  double soles[AT_LEAST_1(3 * SOLES)];
  double unmodelled[6];
} Frozen;

/* x := R^-1 x and x := R^-T x for vectors, a row each, or numbers */
#define SOLVE(F, x, T) \
  FOR(c, C) { T s_ = (x)[c]; FOR(k, c) s_ -= (F)->R[c][k] * (x)[k]; (x)[c] = s_ * (F)->R[c][c]; }
#define SOLVE_TRANSPOSED(F, x, T) \
  for (int c = C - 1; c >= 0; c--) { \
    T s_ = (x)[c]; for (int k = c + 1; k < C; k++) s_ -= (F)->R[k][c] * (x)[k]; (x)[c] = s_ * (F)->R[c][c]; }

static void roots(const double *q, const double *v, const double *normal, Frozen *F) {
  double root[ROOT_NONZEROS], held[AT_LEAST_1(HELD_NONZEROS)];
  const double *in[] = {q, v, normal};
  double *out[] = {root, held, &F->hand_speed, F->soles, F->unmodelled};
  memset(F->unmodelled, 0, sizeof F->unmodelled);
  tree(in, out, 0, 0, 0);
  memset(F->root, 0, sizeof F->root);
  memset(F->held, 0, sizeof F->held);
  double *to = (double *)F->root;
  FOR(i, ROOT_NONZEROS) to[ROOT_AT[i]] = root[i];
  to = (double *)F->held;
  FOR(i, HELD_NONZEROS) to[HELD_AT[i]] = held[i];
}

/* Cholesky's factor of the Delassus matrix, and Z */
static void hold(Frozen *F) {
  double G[C1][VC * LANES];
  FOR(c, C) {
    vec s[VC] = {0};
    for (int k = HELD_ROWS[c]; k < HELD_ROWS[c + 1]; k++) {
      const int r = HELD_ROW[k];
      FOR(i, VC) s[i] += ((double *)F->held[r])[c] * F->held[r][i];
    }
    memcpy(G[c], s, sizeof s);
    G[c][c] += GAMMA[c];
    vec z[V] = {0};
    for (int k = HELD_ROWS[c]; k < HELD_ROWS[c + 1]; k++) {
      const int r = HELD_ROW[k];
      FOR(i, V) z[i] += ((double *)F->held[r])[c] * F->root[r][i];
    }
    FOR(i, V) F->Z[c][i] = z[i];
  }
  FOR(c, C) FOR(k, c + 1) {
    double s = G[c][k];
    FOR(i, k) s -= F->R[c][i] * F->R[k][i];
    F->R[c][k] = k < c ? s * F->R[k][k] : 1.0 / sqrt(s);
  }
  FOR(i, V) {
    FOR(c, C) {
      vec s = F->Z[c][i];
      FOR(k, c) s -= F->R[c][k] * F->Z[k][i];
      F->Z[c][i] = s * F->R[c][c];
    }
  }
}

static void inverse_inertia(Frozen *F) {
  /* the lanes beyond the hand belong to the other velocities */
  double ones[V * LANES] __attribute__((aligned(64)));
  FOR(i, V * LANES) ones[i] = i <= N;
  const vec *kept = (const vec *)ones;
  FOR(c, C) F->Z[c][V - 1] *= kept[V - 1];
  FOR(j, N + 1) {
    vec s[V] = {0};
    for (int k = ROOT_ROWS[j]; k < ROOT_ROWS[j + 1]; k++) {
      const int r = ROOT_ROW[k];
      FOR(i, V) s[i] += ((double *)F->root[r])[j] * F->root[r][i];
    }
    FOR(c, C) FOR(i, V) s[i] -= ((double *)F->Z[c])[j] * F->Z[c][i];
    FOR(i, V) F->Q[j][i] = s[i] * kept[i];
  }
}

/* W of a vector over v, in `root`'s order of columns: a number a row; and its transpose */
static void times_root(const Frozen *F, const vec *x, double *out) {
  FOR(r, NV) out[r] = dot(F->root[r], x, VF);
}
static void times_root_transposed(const Frozen *F, const double *x, double *out) {
  vec s[VF] = {0};
  FOR(r, NV) FOR(i, VF) s[i] += x[r] * F->root[r][i];
  FOR(i, NV) out[i] = ((double *)s)[COLUMN(i)];
}

static void meeting(const double *v, double yields, Frozen *F) {
  memcpy(F->drift_velocity, v, NV * sizeof(double));
#if BIAS || JDOT
  double y[C1], inner[NV], change[NV];
  FOR(c, C) y[c] = ((double *)F->Z[c])[N];
  SOLVE_TRANSPOSED(F, y, double)
  FOR(r, NV) {
    inner[r] = ((double *)F->root[r])[N];
    FOR(c, C) inner[r] -= ((double *)F->held[r])[c] * y[c];
  }
  times_root_transposed(F, inner, change);
  const double m = ((double *)F->Q[N])[N];
  const double approach = F->hand_speed < 0.0 ? 0.0 : F->hand_speed;
  const double impulse = approach / (m + yields);
  FOR(i, NV) F->drift_velocity[i] -= change[i] * impulse;
#endif
}

static void drifts(const double *q, const double *normal, Frozen *F) {
  double push[C1] = {0};
  memset(F->bias_root, 0, sizeof F->bias_root);
  FOR(i, V) F->drift[i] = (vec){0};
#if BIAS || JDOT
  double bias[NV], of_hand = 0.0, of_held[C1];
  const double *in[] = {q, F->drift_velocity, normal};
  double *out[] = {
#if BIAS
    bias,
#endif
#if JDOT
    &of_hand, of_held
#endif
  };
  drift(in, out, 0, 0, 0);
#if BIAS
  vec x[VF] = {0};
  FOR(i, NV) ((double *)x)[COLUMN(i)] = bias[i];
  times_root(F, x, F->bias_root);
  FOR(c, C) for (int k = HELD_ROWS[c]; k < HELD_ROWS[c + 1]; k++)
    push[c] += ((double *)F->held[HELD_ROW[k]])[c] * F->bias_root[HELD_ROW[k]];
  FOR(r, NV) FOR(i, V) F->drift[i] -= F->bias_root[r] * F->root[r][i];
#endif
#if JDOT
  FOR(c, C) push[c] -= of_held[c];
#endif
  SOLVE(F, push, double)
  memcpy(F->push, push, sizeof push);
  FOR(c, C) FOR(i, V) F->drift[i] += push[c] * F->Z[c][i];
  for (int i = N + 1; i < V * LANES; i++) ((double *)F->drift)[i] = 0.0;
  ((double *)F->drift)[N] += of_hand;
#endif
#if WRENCHES
  SOLVE_TRANSPOSED(F, push, double)
  pad(F->L_0, VC, push, C, 0.0);
#endif
}

/* L_tau and L_f: -R^-T Z, by columns */
static void wrenches(Frozen *F) {
#if WRENCHES
  vec y[C1][V];
  memset(F->wrench, 0, sizeof F->wrench);
  memcpy(y, F->Z, sizeof y);
  FOR(i, V) {
    for (int c = C - 1; c >= 0; c--) {
      vec s = y[c][i];
      for (int k = c + 1; k < C; k++) s -= F->R[k][c] * y[k][i];
      y[c][i] = s * F->R[c][c];
    }
  }
  FOR(j, N + 1) FOR(c, C) ((double *)F->wrench[j])[c] = -((double *)y[c])[j];
#endif
}

static void freeze(const double *q, const double *v, const double *normal, double yields, Frozen *F) {
  roots(q, v, normal, F);
  hold(F);
  inverse_inertia(F);
  meeting(v, yields, F);
  drifts(q, normal, F);
  wrenches(F);
}

/* wrench of all that is held for a torque, a force at the hand and the drift's weight */
static void wrench_of(const Frozen *F, const double *torque, double force, double weight, vec *out) {
  FOR(i, VC) out[i] = weight * F->L_0[i] - force * F->wrench[N][i];
  FOR(j, N) FOR(i, VC) out[i] += torque[j] * F->wrench[j][i];
}

/* change of v (nv) from integrals of torque and force over a time; or of position, from second integrals */
static void velocity_change(const Frozen *F, const vec *torque, double impulse, double time, double *out) {
  vec w[VC], x[VF] = {0};
  double inner[NV];
  wrench_of(F, (const double *)torque, impulse, time, w);
  FOR(i, N) ((double *)x)[i] = ((const double *)torque)[i];
  ((double *)x)[N] = -impulse;
  times_root(F, x, inner);
  FOR(r, NV) inner[r] += dot(F->held[r], w, VC) - F->bias_root[r] * time;
  times_root_transposed(F, inner, out);
}
