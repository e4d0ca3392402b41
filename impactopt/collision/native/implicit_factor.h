/* Servo within a step: the factor X that steps of one length share. Law and target, linearized where a step begins. */

/* out = D x, and out = D' x */
INLINE void apply_damping(const Resolvent *r, const vec *x, vec *out) {
#if GAIN_MATRIX
  times_matrix(r->D, x, out);
#else
  FOR(i, V) out[i] = r->D[i] * x[i];
#endif
}
INLINE void apply_damping_transposed(const Resolvent *r, const vec *x, vec *out) {
#if GAIN_MATRIX
  FOR(i, V) out[i] = (vec){0};
  FOR(j, N) ((double *)out)[j] = dot(r->D[j], x, V);
#else
  FOR(i, V) out[i] = r->D[i] * x[i];
#endif
}
#if STIFFNESS
/* out = kp x for the joints that are not saturated, and its transposed */
INLINE void apply_stiffness(const Data *d, const Resolvent *r, const vec *x, vec *out) {
#if KP_MATRIX
  times_matrix(d->kp, x, out);
  FOR(i, V) out[i] *= r->free[i];
#elif GAIN_MATRIX
  FOR(i, V) out[i] = d->kp[i] * r->free[i] * x[i];
#else
  FOR(i, V) out[i] = r->kp[i] * x[i];
#endif
}
INLINE void apply_stiffness_transposed(const Data *d, const Resolvent *r, const vec *x, vec *out) {
#if KP_MATRIX
  vec of[V];
  FOR(i, V) of[i] = r->free[i] * x[i], out[i] = (vec){0};
  FOR(j, N) ((double *)out)[j] = dot(d->kp[j], of, V);
#else
  apply_stiffness(d, r, x, out);
#endif
}
#endif

/* joints per block: as many columns as registers hold */
#define BLOCK (LANES < 4 ? LANES : 4)
#define BLOCKS ((N + BLOCK - 1) / BLOCK)

/* X from Q and D, a block of joints at a time, by the Woodbury formula: X := X - x (1 + g D x_own)^-1 g D x' with the
   columns x of the block. */
static void sweep_all(const vec (*Q)[V], Resolvent *r) {
  const vec(*from)[V] = Q;
  if (!BLOCKS) memcpy(r->X, Q, sizeof r->X);
  FOR(first, BLOCKS) {
    const int at = first * BLOCK;
    double M[BLOCK][BLOCK], W[BLOCK][V * LANES] __attribute__((aligned(64)));
    vec x[BLOCK][V];
    FOR(a, BLOCK) FOR(k, V) x[a][k] = at + a <= N ? from[at + a][k] : (vec){0};
    FOR(a, BLOCK) {
      const double by = at + a < N ? r->g * ((double *)r->D)[at + a] : 0.0;
      FOR(b, BLOCK) M[a][b] = (a == b) + by * ((double *)x[a])[at + b];
      FOR(k, V) ((vec *)W[a])[k] = by * x[a][k];
    }
    FOR(a, BLOCK) {
      const double pivot = 1.0 / M[a][a];
      FOR(b, BLOCK) if (b != a) {
        const double by = M[b][a] * pivot;
        FOR(c, BLOCK) M[b][c] -= by * M[a][c];
        FOR(k, V) ((vec *)W[b])[k] -= by * ((vec *)W[a])[k];
      }
      FOR(k, V) ((vec *)W[a])[k] *= pivot;
      FOR(c, BLOCK) M[a][c] *= pivot;
    }
    FOR(j, N + 1) {
      vec column[V];
      FOR(k, V) column[k] = from[j][k];
      FOR(a, BLOCK) FOR(k, V) column[k] -= W[a][j] * x[a][k];
      FOR(k, V) r->X[j][k] = column[k];
    }
    from = (const vec(*)[V])r->X;
  }
}

/* X for D + change at joint i (Sherman-Morrison). */
INLINE void sweep(Resolvent *r, int i, double change) {
  const double pivot = ((double *)r->X[i])[i], factor = r->g * change / (1.0 + r->g * change * pivot);
  vec x[V];
  FOR(k, V) x[k] = r->X[i][k];
  FOR(j, N + 1) {
    const double by = factor * ((double *)x)[j];
    FOR(k, V) r->X[j][k] -= by * x[k];
  }
}

/* slope of joint friction by velocity */
INLINE vec friction_slope(const Data *d, const Instant *now, int i) {
#if FRICTION
  const bits slides = magnitude(d->joint_velocity[i] + now->u[i]) > TRANSITION;
  return d->viscous[i] + choose(slides, (vec){0}, d->coulomb[i] / TRANSITION);
#else
  return (vec){0};
#endif
}
INLINE bits not_saturated(const Instant *now, int i) { return now->torque[i] == now->demand[i]; }

#if GAIN_MATRIX
/* Rows of X from (I + g Q D) X = Q, by Gauss-Jordan elimination with row pivots. */
static void factor(const vec (*Q)[V], Resolvent *r) {
  vec M[N + 1][V];
  int of[N + 1];
  FOR(i, N + 1) {
    FOR(k, V) M[i][k] = (vec){0}, r->rows[i][k] = Q[i][k];
    FOR(j, N) ((double *)M[i])[j] = r->g * dot(Q[i], r->D[j], V);
    ((double *)M[i])[i] += 1.0;
    of[i] = i;
  }
  FOR(c, N + 1) {
    int best = c;
    for (int i = c + 1; i <= N; i++)
      if (fabs(((double *)M[of[i]])[c]) > fabs(((double *)M[of[best]])[c])) best = i;
    const int p = of[best];
    of[best] = of[c], of[c] = p;
    const double pivot = 1.0 / ((double *)M[p])[c];
    FOR(k, V) M[p][k] *= pivot, r->rows[p][k] *= pivot;
    FOR(i, N + 1) if (i != p) {
      const double by = ((double *)M[i])[c];
      if (by != 0.0) FOR(k, V) M[i][k] -= by * M[p][k], r->rows[i][k] -= by * r->rows[p][k];
    }
  }
  vec found[N + 1][V];
  memset(r->X, 0, sizeof r->X);
  FOR(i, N + 1) memcpy(found[i], r->rows[of[i]], sizeof found[i]);
  memcpy(r->rows, found, sizeof found);
  FOR(i, N + 1) FOR(j, N + 1) ((double *)r->X[j])[i] = ((double *)r->rows[i])[j];
}

static void factor_servo(const Data *d, const Instant *now, double h, Resolvent *r) {
  const double g = GAMMA_OF_STEPS * h;
  vec D[N1][V], free_[V];
  FOR(i, V) {
    const vec one = (vec){0} + 1.0;
    free_[i] = choose(not_saturated(now, i), one, (vec){0});
    const vec slope = friction_slope(d, now, i);
    FOR(j, N) {
      vec unit = {0};
      if (j / LANES == i) ((double *)&unit)[j % LANES] = 1.0;
#if KD_MATRIX
      vec gain = d->kd[j][i];
#else
      vec gain = unit * d->kd[i];
#endif
#if STIFFNESS && KP_MATRIX
      gain += g * d->kp[j][i];
#elif STIFFNESS
      gain += g * unit * d->kp[i];
#endif
      D[j][i] = gain * free_[i] + unit * slope;
    }
  }
  if (r->h == h && !memcmp(r->D, D, sizeof D)) return;
  memcpy(r->D, D, sizeof D);
  memcpy(r->free, free_, sizeof free_);
  r->h = h, r->g = g;
  factor((const vec(*)[V])d->frozen->Q, r);
}
#else
/* D of the joints that are not saturated. */
INLINE void dampers(const Data *d, const Instant *now, double g, vec *D, vec *kp) {
  FOR(i, V) {
    const bits free_ = not_saturated(now, i);
    vec held = d->kd[i];
    kp[i] = (vec){0};
#if STIFFNESS
    kp[i] = SATURATION ? (vec)((bits)d->kp[i] & free_) : d->kp[i];
    held += g * d->kp[i];
#endif
    D[i] = SATURATION ? (vec)((bits)held & free_) : held;
    if (FRICTION) D[i] += friction_slope(d, now, i);
  }
}

static void factor_servo(const Data *d, const Instant *now, double h, Resolvent *r) {
  vec D[V], kp[V];
  const double g = GAMMA_OF_STEPS * h;
  dampers(d, now, g, D, kp);
  int change[N1], changes = 0;
  double *was = (double *)r->D;
  const double *is = (const double *)D;
  if (r->h == h)
    FOR(i, N) if (is[i] != was[i]) change[changes++] = i;
  int refactor = r->h != h || changes > N / 4;
  FOR(k, refactor ? 0 : changes) {
    const int i = change[k];
    const double more = is[i] - was[i];
    /* removing a stiff damper by an update would leave rounding errors */
    if (1.0 + g * more * ((double *)r->X[i])[i] < 1e-3) {
      refactor = 1;
      break;
    }
    sweep(r, i, more);
  }
  memcpy(r->D, D, sizeof D);
  if (refactor) {
    r->h = h, r->g = g;
    sweep_all((const vec(*)[V])d->frozen->Q, r);
  }
  memcpy(r->kp, kp, sizeof kp);
}
#endif

/* Force [N] in this phase, and its slopes by penetration and rate. */
INLINE void law_and_slopes(const Data *d, double x, double rate, int compressing, double *found) {
#if LAW_NONLINEAR
  const double *in[] = {&x, &rate, d->law};
  double *out[] = {found};
  if (compressing) law_compressing(in, out, 0, 0, 0);
  else law_restoring(in, out, 0, 0, 0);
#else
  double law[4];
  const double *in[] = {d->law};
  double *out[] = {law};
  law_slopes(in, out, 0, 0, 0);
  const double *mine = law + 2 * compressing;
  found[0] = mine[0] * x + mine[1] * rate, found[1] = mine[0], found[2] = mine[1];
#endif
}

static void linearize_contact(const Data *d, const State *y, const Instant *now, double g, double mobility,
                              Contact *c) {
  double law[3];
  law_and_slopes(d, y->penetration, now->rate, now->compressing, law);
  c->force = law[0], c->k = law[1], c->d = law[2];
  c->mobility = mobility;
  c->bare_mobility = ((const double *)d->frozen->Q[N])[N];
#if NZ
  const double *at[] = {y->target, &c->force, d->target};
  double Z[NZ * NZ], *slopes[] = {Z, c->G, c->at}, *rates[] = {c->rates};
  target_slopes(at, slopes, 0, 0, 0);
  target_rates(at, rates, 0, 0, 0);
  double M[NZ][NZ];
  FOR(i, NZ) FOR(j, NZ) {
    c->Z[i][j] = Z[i + NZ * j];
    M[i][j] = (i == j) - g * c->Z[i][j];
    c->inverse[i][j] = i == j;
  }
  FOR(i, NZ) {
    const double pivot = 1.0 / M[i][i];
    FOR(j, NZ) M[i][j] *= pivot, c->inverse[i][j] *= pivot;
    FOR(k, NZ) if (k != i) {
      const double by = M[k][i];
      FOR(j, NZ) M[k][j] -= by * M[i][j], c->inverse[k][j] -= by * c->inverse[i][j];
    }
  }
  FOR(i, NZ) {
    c->state_by_force[i] = 0.0;
    FOR(j, NZ) c->state_by_force[i] += c->inverse[i][j] * c->G[j];
    c->mobility += c->at[i] * c->state_by_force[i];
    c->bare_mobility += c->at[i] * c->G[i];
  }
#endif
}

/* Linearizes servo, law and target for a step of length h. */
static void linearize_step(const Data *d, const State *y, const Instant *now, double h, Resolvent *r) {
  factor_servo(d, now, h, r);
  linearize_contact(d, y, now, r->g, ((double *)r->X[N])[N], &r->contact);
}
