/* Tangents of what is frozen; see freeze.h and forward.h. With B the roots of joints and hand, U = B - W_c P and
   E = dB - dW_c P,

       dQ = U' E + E' U,    dP = G^-1 (dW_c' U + W_c' E),    G the Delassus matrix, P = G^-1 W_c' B */

typedef struct {
  FrozenTangent frozen;
  vec E[NV][N + 1][VD], root[ROOT_NONZEROS][VD], held[AT_LEAST_1(HELD_NONZEROS)][VD];
  vec U[NV][V], P[C1][V], identity[NV][VD], none[NV][VD];
  double parts[TREE_PARTS];
} FreezeForward;

#define ROW_OF_ROOT(i) (ROOT_AT[i] / (VF * LANES))
#define COLUMN_OF_ROOT(i) (ROOT_AT[i] % (VF * LANES))
#define ROW_OF_HELD(i) (HELD_AT[i] / (VC * LANES))
#define COLUMN_OF_HELD(i) (HELD_AT[i] % (VC * LANES))
/* which of v a column of `root` is of; the hand's is none */
#define VELOCITY(c) ((c) < N ? (c) + NV - N : (c) - N - 1)

/* x := G^-1 x, a row of directions each */
static void by_delassus(const Frozen *F, vec *x, int stride) {
  FOR(c, C) FOR_EACH(k) {
    vec s = x[c * stride + k];
    FOR(b, c) s -= F->R[c][b] * x[b * stride + k];
    x[c * stride + k] = s * F->R[c][c];
  }
  for (int c = C - 1; c >= 0; c--) FOR_EACH(k) {
    vec s = x[c * stride + k];
    for (int b = c + 1; b < C; b++) s -= F->R[b][c] * x[b * stride + k];
    x[c * stride + k] = s * F->R[c][c];
  }
}

static void roots_forward(const double *q, const double *v, const double *normal, const Frozen *F, FreezeForward *w) {
  FrozenTangent *t = &w->frozen;
  memset(w->identity, 0, sizeof w->identity);
  memset(w->none, 0, sizeof w->none);
  memset(t->unmodelled, 0, sizeof t->unmodelled);
  memset(t->hand_speed, 0, sizeof t->hand_speed);
  FOR(i, NV) *lane(w->identity[i], i) = 1.0;
  const double *in[] = {q, v, normal};
  double *parts[] = {w->parts};
  const vec *seed[] = {w->identity[0]};
  vec *by_q[] = {w->root[0], w->held[0], t->hand_speed[BY_Q], t->soles[0], t->unmodelled[BY_Q][0]};
  vec *by_v[] = {t->hand_speed[BY_V], t->unmodelled[BY_V][0]};
  tree_parts(in, parts, 0, 0, 0);
  tree_forward(w->parts, seed, by_q, VD);
  double few[APPROACH_PARTS];
  parts[0] = few;
  approach_parts(in, parts, 0, 0, 0);
  approach_forward(few, seed, by_v, VD);

  /* P, U, E */
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
  memset(w->E, 0, sizeof w->E);
  FOR(i, ROOT_NONZEROS) if (COLUMN_OF_ROOT(i) <= N)
    FOR_EACH(k) w->E[ROW_OF_ROOT(i)][COLUMN_OF_ROOT(i)][k] += w->root[i][k];
  FOR(i, HELD_NONZEROS) {
    const double *P = (const double *)w->P[COLUMN_OF_HELD(i)];
    FOR(j, N + 1) FOR_EACH(k) w->E[ROW_OF_HELD(i)][j][k] -= P[j] * w->held[i][k];
  }
}

static void inverse_inertia_forward(const Frozen *F, FreezeForward *w) {
  FrozenTangent *t = &w->frozen;
  memset(t->Q, 0, sizeof t->Q);
  add_product((const vec(*)[V])w->U, NV, w->E[0][0], (N + 1) * VD, t->Q[0][0]);
  FOR(i, N + 1) FOR(j, i + 1) FOR_EACH(k) t->Q[i][j][k] = t->Q[j][i][k] = t->Q[i][j][k] + t->Q[j][i][k];
  /* without wrenches, the hand's column alone */
  const int first = HELD_HISTORY ? 0 : N;
  memset(t->P, 0, sizeof t->P);
  FOR(i, HELD_NONZEROS) {
    const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
    const double *U = (const double *)w->U[r], by = ((const double *)F->held[r])[c];
    for (int j = first; j <= N; j++) FOR_EACH(k) t->P[c][j][k] += U[j] * w->held[i][k] + by * w->E[r][j][k];
  }
  for (int j = first; j <= N; j++) by_delassus(F, t->P[0][j], (N + 1) * VD);
}

/* the velocity that drifts are frozen at */
static void meeting_forward(double yields, const Frozen *F, const FreezeForward *w, vec velocity[2][NV][VD]) {
  const FrozenTangent *t = &w->frozen;
  const double yielding = ((double *)F->Q[N])[N] + yields;
  const double impulse = (F->closing < 0.0 ? 0.0 : F->closing) / yielding;
  double inner[NV], change[NV];
  vec hand[NV][VD];
  FOR(r, NV) {
    inner[r] = ((const double *)w->U[r])[N];
    FOR_EACH(k) hand[r][k] = w->E[r][N][k];
  }
  FOR(i, HELD_NONZEROS) {
    const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
    FOR_EACH(k) hand[r][k] -= ((const double *)F->held[r])[c] * t->P[c][N][k];
  }
  times_root_transposed(F, inner, change);
  memset(velocity[BY_Q], 0, sizeof velocity[BY_Q]);
  memcpy(velocity[BY_V], w->identity, sizeof velocity[BY_V]);
  FOR(i, ROOT_NONZEROS) {
    const int r = ROW_OF_ROOT(i), c = COLUMN_OF_ROOT(i);
    if (c == N) continue;
    const double by = ((const double *)F->root[r])[c] * impulse;
    FOR_EACH(k) velocity[BY_Q][VELOCITY(c)][k] -= by * hand[r][k] + inner[r] * impulse * w->root[i][k];
  }
  FOR(kind, 2) {
    vec more[VD];
    FOR_EACH(k) {
      more[k] = either(F->closing < 0.0, (vec){0}, t->hand_speed[kind][k] / yielding);
      if (kind == BY_Q) more[k] -= t->Q[N][N][k] * (impulse / yielding);
    }
    FOR(i, NV) FOR_EACH(k) velocity[kind][i][k] -= change[i] * more[k];
  }
}

static void drifts_forward(const double *q, const double *normal, double yields, const Frozen *F, FreezeForward *w) {
  FrozenTangent *t = &w->frozen;
  memset(t->drift, 0, sizeof t->drift);
  memset(t->L_0, 0, sizeof t->L_0);
#if BIAS || JDOT
  vec velocity[2][NV][VD], of_bias[NV][VD], of_hand[VD], of_held[C1][VD];
  double parts[DRIFT_PARTS], bias[NV], at_hand, at_held[C1], L_0[C1], rest[NV];
  const double *in[] = {q, F->drift_velocity, normal};
  double *to[] = {parts}, *out[] = {
#if BIAS
    bias,
#endif
#if JDOT
    &at_hand, at_held
#endif
  };
  meeting_forward(yields, F, w, velocity);
  drift(in, out, 0, 0, 0);
  drift_parts(in, to, 0, 0, 0);
  memcpy(L_0, F->push, sizeof L_0);
  SOLVE_TRANSPOSED(F, L_0, double)
  FOR(r, NV) {
    rest[r] = -F->bias_root[r];
    FOR(c, C) rest[r] += ((const double *)F->held[r])[c] * L_0[c];
  }
  FOR(kind, 2) {
    const vec *seed[] = {kind == BY_Q ? w->identity[0] : w->none[0], velocity[kind][0]};
    vec *moved[] = {
#if BIAS
      of_bias[0],
#endif
#if JDOT
      of_hand, of_held[0]
#endif
    };
    drift_forward(parts, seed, moved, VD);
    vec root[NV][VD], (*push)[VD] = t->L_0[kind], (*sum)[VD] = t->drift[kind];
    memset(root, 0, sizeof root);
#if BIAS
    FOR(i, ROOT_NONZEROS) {
      const int r = ROW_OF_ROOT(i), c = COLUMN_OF_ROOT(i);
      if (c == N) continue;
      const double by = ((const double *)F->root[r])[c], of = kind == BY_Q ? bias[VELOCITY(c)] : 0.0;
      FOR_EACH(k) root[r][k] += by * of_bias[VELOCITY(c)][k] + of * w->root[i][k];
    }
#endif
    /* less dW_c L_0: then the wrenches have G^-1 W_c' of it */
    if (kind == BY_Q) FOR(i, HELD_NONZEROS) FOR_EACH(k)
      root[ROW_OF_HELD(i)][k] -= L_0[COLUMN_OF_HELD(i)] * w->held[i][k];
    FOR(i, HELD_NONZEROS) {
      const int r = ROW_OF_HELD(i), c = COLUMN_OF_HELD(i);
      const double by = ((const double *)F->held[r])[c];
      FOR_EACH(k) push[c][k] += by * root[r][k];
      if (kind == BY_Q) FOR_EACH(k) push[c][k] -= rest[r] * w->held[i][k];
    }
    if (kind == BY_Q) FOR(r, NV) FOR(j, N + 1) FOR_EACH(k) sum[j][k] += rest[r] * w->E[r][j][k];
    FOR(r, NV) FOR_EACH(k) root[r][k] = -root[r][k];
    add_product((const vec(*)[V])w->U, NV, root[0], VD, sum[0]);
#if JDOT
    FOR(c, C) FOR_EACH(k) {
      push[c][k] -= of_held[c][k];
      FOR(j, N + 1) sum[j][k] -= ((const double *)w->P[c])[j] * of_held[c][k];
    }
    FOR_EACH(k) sum[N][k] += of_hand[k];
#endif
    by_delassus(F, push[0], VD);
  }
#endif
}

static void freeze_forward(const double *q, const double *v, const double *normal, double yields, const Frozen *F,
                           FreezeForward *w) {
  roots_forward(q, v, normal, F, w);
  inverse_inertia_forward(F, w);
  drifts_forward(q, normal, yields, F, w);
}
