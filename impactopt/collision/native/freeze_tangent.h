/* Tangents of the frozen model, one vector of directions after the other; see freeze.h and tangent.h. With B the roots
   of joints and hand, U = B - W_c P and E = dB - dW_c P,

       dQ = U' E + E' U,    dP = G^-1 (dW_c' U + W_c' E),    G the Delassus matrix, P = G^-1 W_c' B */

typedef struct {
  FrozenTangent frozen;
  vec U[NV][V], P[C1][V];
  double tree_parts[TREE_PARTS], approach_parts[APPROACH_PARTS];
  /* of the velocity after a plastic touch, and of the drifts there */
  double impulse, mobility, inner[NV], change[NV], bias[NV], L_0[C1], rest[NV];
#if BIAS || JDOT
  double drift_parts[DRIFT_PARTS];
#endif
  /* for one vector of directions: seeds of q and v, tangents of the roots, E, tangents of P and of the soles */
  vec by_q[NV], by_v[NV], root[ROOT_NONZEROS], held[AT_LEAST_1(HELD_NONZEROS)];
  vec E[NV][COLUMNS_OF_V], P_by[C1][N + 1], soles[AT_LEAST_1(3 * SOLES)], unmodelled[SIX], L_0_by[C1];
} FreezeTangent;

#define ROW_OF_ROOT(i) (ROOT_AT[i] / (VF * LANES))
#define COLUMN_OF_ROOT(i) (ROOT_AT[i] % (VF * LANES))
#define ROW_OF_HELD(i) (HELD_AT[i] / (VC * LANES))
#define COLUMN_OF_HELD(i) (HELD_AT[i] % (VC * LANES))
/* index in v of a column of `root`; the hand's has none */
#define VELOCITY(c) ((c) < N ? (c) + NV - N : (c) - N - 1)

/* x := G^-1 x, `width` right-hand sides */
static void by_delassus(const Frozen *F, vec *x, int width) {
  FOR(c, C) FOR(j, width) {
    vec s = x[c * width + j];
    FOR(b, c) s -= F->R[c][b] * x[b * width + j];
    x[c * width + j] = s * F->R[c][c];
  }
  for (int c = C - 1; c >= 0; c--) FOR(j, width) {
    vec s = x[c * width + j];
    for (int b = c + 1; b < C; b++) s -= F->R[b][c] * x[b * width + j];
    x[c * width + j] = s * F->R[c][c];
  }
}

/* ------------------------------------------------------------ parts that all directions share */
static void tree_shared(const Frozen *F, FreezeTangent *w) {
  memcpy(w->P, F->Z, sizeof w->P);
  FOR(i, V) for (int c = C - 1; c >= 0; c--) {
    vec s = w->P[c][i];
    for (int b = c + 1; b < C; b++) s -= F->R[b][c] * w->P[b][i];
    w->P[c][i] = s * F->R[c][c];
  }
  FOR(r, NV) {
    FOR(i, V) w->U[r][i] = F->root[r][i];
    FOR(c, C) FOR(i, V) w->U[r][i] -= ((double *)F->held[r])[c] * w->P[c][i];
    for (int i = N + 1; i < ROWS_OF_V; i++) ((double *)w->U[r])[i] = 0.0;
  }
}

static void drifts_shared(const double *q, const double *normal, double target_inverse_mass, const Frozen *F,
                          FreezeTangent *w) {
#if BIAS || JDOT
  w->mobility = ((double *)F->Q[N])[N] + target_inverse_mass;
  w->impulse = (F->approach_speed < 0.0 ? 0.0 : F->approach_speed) / w->mobility;
  FOR(r, NV) w->inner[r] = ((const double *)w->U[r])[N];
  times_root_transposed(F, w->inner, w->change);
  double at_hand, at_held[C1];
  const double *in[] = {q, F->drift_velocity, normal};
  double *to[] = {w->drift_parts}, *out[] = {
#if BIAS
    w->bias,
#endif
#if JDOT
    &at_hand, at_held
#endif
  };
  drift(in, out, 0, 0, 0);
  drift_parts(in, to, 0, 0, 0);
  memcpy(w->L_0, F->held_push, sizeof w->L_0);
  SOLVE_TRANSPOSED(F, w->L_0, double)
  FOR(r, NV) {
    w->rest[r] = -F->bias_root[r];
    FOR(c, C) w->rest[r] += ((const double *)F->held[r])[c] * w->L_0[c];
  }
#else
  memset(w->L_0, 0, sizeof w->L_0);
#endif
}

static void reactions_shared(const Frozen *F, FreezeTangent *w) {
#if HELD_HISTORY
  memset(w->frozen.by, 0, sizeof w->frozen.by);
  FOR(j, N + 1) {
    double x[C1];
    FOR(c, C) x[c] = ((const double *)w->P[c])[j];
#if HELD_ASKED
    FOR(c, C) w->frozen.by[c / SIX][j][c % SIX] = x[c];
#endif
#if GROUND_ASKED
    double *sum = w->frozen.by[WRENCHES_ASKED - 1][j];
    FOR(s, SOLES) FOR(i, SIX) {
      const int a = (i + 1) % 3, b = (i + 2) % 3;
      const double *p = F->soles + 3 * s, *f = x + SIX * s;
      sum[i] += f[i];
      if (i >= 3) sum[i] += p[a] * f[b] - p[b] * f[a];
    }
#endif
  }
#endif
}

/* ------------------------------------------------------------ for one vector of directions */
static void tree_derivatives(int k, FreezeTangent *w) {
  FrozenTangent *t = &w->frozen;
  vec speed, wrench[SIX] = {0};
  const vec *moves[] = {w->by_v};
  vec *by_v[] = {&speed, wrench};
  memset(w->unmodelled, 0, sizeof w->unmodelled);
  memset(w->soles, 0, sizeof w->soles);
  if (k < VECTORS_OF_Q) {
    const vec *turns[] = {w->by_q};
    vec *by_q[] = {w->root, w->held, &t->hand_speed[k], w->soles, w->unmodelled};
    tree_tangent(w->tree_parts, turns, by_q);
    memset(w->E, 0, sizeof w->E);
    FOR(i, ROOT_NONZEROS) if (COLUMN_OF_ROOT(i) <= N) w->E[ROW_OF_ROOT(i)][COLUMN_OF_ROOT(i)] += w->root[i];
    FOR(i, HELD_NONZEROS) {
      const double *P = (const double *)w->P[COLUMN_OF_HELD(i)];
      FOR(j, N + 1) w->E[ROW_OF_HELD(i)][j] -= P[j] * w->held[i];
    }
  }
  approach_tangent(w->approach_parts, moves, by_v);
  t->hand_speed[k] += speed;
  FOR(i, SIX) w->unmodelled[i] += wrench[i];
}

static void inverse_inertia_tangent(int k, const Frozen *F, FreezeTangent *w) {
  vec(*Q)[COLUMNS_OF_V] = w->frozen.Q[k];
  FOR(j, N + 1) {
    vec column[NV], sum[ROWS_OF_V];
    FOR(r, NV) column[r] = w->E[r][j];
    add_product((const vec(*)[V])w->U, NV, column, 0, sum);
    FOR(i, ROWS_OF_V) Q[i][j] = sum[i];
  }
  FOR(i, N + 1) FOR(j, i + 1) Q[i][j] = Q[j][i] = Q[i][j] + Q[j][i];
  /* without wrenches only the hand's column is needed */
  const int first = HELD_HISTORY ? 0 : N;
  memset(w->P_by, 0, sizeof w->P_by);
  FOR(i, HELD_NONZEROS) {
    const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
    const double *U = (const double *)w->U[r], by = ((const double *)F->held[r])[c];
    for (int j = first; j <= N; j++) w->P_by[c][j] += U[j] * w->held[i] + by * w->E[r][j];
  }
  by_delassus(F, w->P_by[0], N + 1);
}

#if BIAS || JDOT
/* Tangent of the velocity that the drifts are evaluated at. */
static void plastic_velocity_tangent(int k, const Frozen *F, const FreezeTangent *w, vec *velocity) {
  const FrozenTangent *t = &w->frozen;
  vec more = either(F->approach_speed < 0.0, (vec){0}, t->hand_speed[k] / w->mobility);
  memcpy(velocity, w->by_v, sizeof w->by_v);
  if (k < VECTORS_OF_Q) {
    vec hand[NV];
    FOR(r, NV) hand[r] = w->E[r][N];
    FOR(i, HELD_NONZEROS) {
      const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
      hand[r] -= ((const double *)F->held[r])[c] * w->P_by[c][N];
    }
    FOR(i, ROOT_NONZEROS) {
      const int r = ROW_OF_ROOT(i), c = COLUMN_OF_ROOT(i);
      if (c == N) continue;
      const double by = ((const double *)F->root[r])[c] * w->impulse;
      velocity[VELOCITY(c)] -= by * hand[r] + w->inner[r] * w->impulse * w->root[i];
    }
    more -= t->Q[k][N][N] * (w->impulse / w->mobility);
  }
  FOR(i, NV) velocity[i] -= w->change[i] * more;
}
#endif

static void drifts_tangent(int k, const Frozen *F, FreezeTangent *w) {
  FrozenTangent *t = &w->frozen;
  vec *sum = t->drift[k], *held_push = w->L_0_by;
  memset(held_push, 0, sizeof w->L_0_by);
#if BIAS || JDOT
  vec velocity[NV], of_bias[NV], of_hand, of_held[C1], root[NV];
  plastic_velocity_tangent(k, F, w, velocity);
  const vec *seed[] = {w->by_q, velocity};
  vec *moved[] = {
#if BIAS
    of_bias,
#endif
#if JDOT
    &of_hand, of_held
#endif
  };
  drift_tangent(w->drift_parts, seed, moved);
  memset(root, 0, sizeof root);
#if BIAS
  FOR(i, ROOT_NONZEROS) {
    const int r = ROW_OF_ROOT(i), c = COLUMN_OF_ROOT(i);
    if (c == N) continue;
    root[r] += ((const double *)F->root[r])[c] * of_bias[VELOCITY(c)];
    if (k < VECTORS_OF_Q) root[r] += w->bias[VELOCITY(c)] * w->root[i];
  }
#endif
  /* less dW_c L_0, so that G^-1 W_c' of it is the tangent of the wrenches */
  if (k < VECTORS_OF_Q) {
    FOR(i, HELD_NONZEROS) {
      const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
      root[r] -= w->L_0[c] * w->held[i];
      held_push[c] -= w->rest[r] * w->held[i];
    }
    FOR(r, NV) FOR(j, N + 1) sum[j] += w->rest[r] * w->E[r][j];
  }
  FOR(i, HELD_NONZEROS) {
    const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
    held_push[c] += ((const double *)F->held[r])[c] * root[r];
  }
  FOR(r, NV) root[r] = -root[r];
  add_product((const vec(*)[V])w->U, NV, root, sum, sum);
#if JDOT
  FOR(c, C) {
    held_push[c] -= of_held[c];
    FOR(j, N + 1) sum[j] -= ((const double *)w->P[c])[j] * of_held[c];
  }
  sum[N] += of_hand;
#endif
  by_delassus(F, held_push, 1);
#endif
}

/* Tangents of the wrenches that the histories need. */
static void reactions_tangent(int k, const Frozen *F, FreezeTangent *w) {
#if HELD_HISTORY
  FrozenTangent *t = &w->frozen;
  const int moves = k < VECTORS_OF_Q;
#if HELD_ASKED
  FOR(c, C) {
    t->wrench_begin[k][c / SIX][c % SIX] = w->L_0_by[c];
    if (moves) FOR(j, N + 1) t->wrench_by[k][c / SIX][j][c % SIX] = w->P_by[c][j];
  }
#endif
#if GROUND_ASKED
  const int last = WRENCHES_ASKED - 1;
  vec *begin = t->wrench_begin[k][last], (*by)[SIX] = t->wrench_by[k][last];
  memcpy(begin, w->unmodelled, sizeof w->unmodelled);
  if (moves) memset(by, 0, sizeof t->wrench_by[k][last]);
  FOR(s, SOLES) FOR(i, SIX) {
    const int a = (i + 1) % 3, b = (i + 2) % 3, turns = i >= 3;
    const double *p = F->soles + 3 * s, *f = w->L_0 + SIX * s;
    const vec *dp = w->soles + 3 * s, *df = w->L_0_by + SIX * s;
    begin[i] += df[i];
    if (turns) begin[i] += p[a] * df[b] - p[b] * df[a] + f[b] * dp[a] - f[a] * dp[b];
    const vec(*P)[V] = (const vec(*)[V])w->P + SIX * s;
    const vec(*dP)[N + 1] = (const vec(*)[N + 1])w->P_by + SIX * s;
    if (moves) FOR(j, N + 1) {
      by[j][i] += dP[i][j];
      if (turns) by[j][i] += p[a] * dP[b][j] - p[b] * dP[a][j]
                             + ((const double *)P[b])[j] * dp[a] - ((const double *)P[a])[j] * dp[b];
    }
  }
#endif
#endif
}

/* Tangents of the frozen model for the requested vectors. */
static void freeze_tangent(const double *q, const double *v, const double *normal, double target_inverse_mass,
                           const Frozen *F, const int *wanted, FreezeTangent *w) {
  const double *in[] = {q, v, normal};
  double *tree_out[] = {w->tree_parts}, *approach_out[] = {w->approach_parts};
  tree_parts(in, tree_out, 0, 0, 0);
  approach_parts(in, approach_out, 0, 0, 0);
  memset(w->frozen.drift, 0, sizeof w->frozen.drift);
  memset(w->frozen.hand_speed, 0, sizeof w->frozen.hand_speed);
  memset(w->frozen.wrench_begin, 0, sizeof w->frozen.wrench_begin);
  tree_shared(F, w);
  drifts_shared(q, normal, target_inverse_mass, F, w);
  reactions_shared(F, w);
  FOR(k, VECTORS_OF_V) {
    if (!wanted[k]) continue;
    memset(w->by_q, 0, sizeof w->by_q);
    memset(w->by_v, 0, sizeof w->by_v);
    FOR(l, LANES) {
      const int direction = k * LANES + l;
      if (direction < NV) ((double *)&w->by_q[direction])[l] = 1.0;
      else if (direction < 2 * NV) ((double *)&w->by_v[direction - NV])[l] = 1.0;
    }
    tree_derivatives(k, w);
    if (k < VECTORS_OF_Q) inverse_inertia_tangent(k, F, w);
    drifts_tangent(k, F, w);
    reactions_tangent(k, F, w);
  }
}
