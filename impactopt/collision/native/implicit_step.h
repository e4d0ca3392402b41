/* The stages of one step. */

typedef struct {
  vec torque[V], deviation[V];
  double impulse, penetration, time, target[NZ1];
} Right;

typedef struct {
  vec speeds[V];
  double impulse, penetration, rate, force, target[NZ1];
} Left;

/* S r with a stage's inputs, as far as it is needed */
INLINE void solve(const Data *d, const Resolvent *r, const Right *b, const double *inputs, Left *x) {
  const Contact *c = &r->contact;
  vec rho[V], a[V], held[V];
  FOR(i, V) rho[i] = b->torque[i], a[i] = (vec){0};
#if STIFFNESS
  sprung(d, r, b->deviation, held);
  FOR(i, V) rho[i] += r->g * held[i];
#endif
#if BIAS || JDOT
  if (b->time != 0.0) {
    FOR(i, V) a[i] = d->frozen->drift[i] * b->time;
    damped(r, a, held);
    FOR(i, V) rho[i] -= r->g * held[i];
  }
#endif
  (void)held;
  add_columns(r->X, N, (const double *)rho, a);
  const double own = ((double *)r->X[N])[N];
  double rate = a[N / LANES][N % LANES] - own * b->impulse, of_target[NZ1];
  FOR(i, NZ) {
    of_target[i] = 0.0;
    FOR(k, NZ) of_target[i] += c->inverse[i][k] * (b->target[k] + (TARGET_BENDS ? r->g * inputs[1 + k] : 0.0));
    rate -= c->at[i] * of_target[i];
  }
  if (TARGET_BENDS) rate -= inputs[INPUTS - 1];
  const double slope = c->k * r->g + c->d, more = BENDS ? inputs[0] : 0.0;
  x->force = (c->k * b->penetration + slope * rate + more) / (1.0 + slope * r->g * c->mobility);
  x->impulse = b->impulse + r->g * x->force;
  x->rate = rate - r->g * c->mobility * x->force;
  x->penetration = b->penetration + r->g * x->rate;
  FOR(i, NZ) x->target[i] = of_target[i] + r->g * c->moved[i] * x->force;
  FOR(i, V) x->speeds[i] = a[i] - r->X[N][i] * x->impulse;
}

/* the terms of a step but the first, from the right-hand side of the first stage, and inputs n */
INLINE void make_terms(const Data *d, const Resolvent *r, Right *b, const Inputs n, Series *s) {
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS;
  double inputs[INPUTS] = {0};
  Left x;
  vec net[V], held[V];
  FOR(j, STAGES) {
    if (BENDS) FOR(k, INPUTS) inputs[k] = j ? n[j][k] + GAMMA_OF_STEPS * n[j + 1][k] : n[1][k];
    if (j) {
      b->impulse = s->impulse[j];
      b->penetration = s->penetration[j];
      b->time = j == 1 ? b->time : 0.0;
      FOR(i, NZ) b->target[i] = s->target[i][j];
      FOR(i, V) b->torque[i] = s->torque[j][i], b->deviation[i] = s->deviation[j][i];
    }
    solve(d, r, b, inputs, &x);
    damped(r, x.speeds, net);
    FOR(i, V) net[i] = -net[i];
#if STIFFNESS
    sprung(d, r, b->deviation, held);
    FOR(i, V) net[i] += held[i];
#endif
    (void)held;
    FOR(i, V) {
      s->torque[j + 1][i] = either(j, h * net[i], b->torque[i] + r->g * net[i]);
      s->deviation[j + 1][i] = either(j, -h * x.speeds[i], b->deviation[i] - r->g * x.speeds[i]);
      s->speeds[j + 1][i] = either(j, (x.speeds[i] - s->speeds[j][i]) * by_gamma, x.speeds[i]);
    }
    s->impulse[j + 1] = j ? h * x.force : x.impulse;
    s->penetration[j + 1] = j ? h * x.rate : x.penetration;
    s->rate[j + 1] = j ? (x.rate - s->rate[j]) * by_gamma : x.rate;
    s->force[j + 1] = j ? (x.force - s->force[j]) * by_gamma : x.force;
    FOR(i, NZ) s->target[i][j + 1] = j ? (x.target[i] - s->target[i][j]) * by_gamma : x.target[i];
    servo(d, s->speeds[j + 1], s->deviation[j + 1], s->demand[j + 1]);
  }
}

static void make_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, const Inputs n, Series *s) {
  const Contact *c = &r->contact;
  const double h = r->h;
  Right b;
  s->impulse[0] = y->impulse;
  s->penetration[0] = y->penetration;
  s->rate[0] = now->rate;
  s->force[0] = c->force;
  b.impulse = h * s->force[0];
  b.penetration = h * now->rate;
  b.time = h;
  FOR(i, NZ) s->target[i][0] = y->target[i], b.target[i] = h * c->rates[i];
  FOR(i, V) {
    s->torque[0][i] = y->torque[i];
    s->deviation[0][i] = STIFFNESS ? y->deviation[i] : (vec){0};
    s->speeds[0][i] = now->u[i];
    s->demand[0][i] = now->demand[i];
    b.torque[i] = h * now->net[i];
    b.deviation[i] = -h * now->u[i];
  }
  make_terms(d, r, &b, n, s);
}

/* what a further term would add to the hand's speed and the joints' demands, of what is allowed. A speed that swings
   has terms that swing: one of them may be next to nothing while the penetration's is not, two in a row are not */
INLINE double error_of(const Data *d, const Resolvent *r, const Series *s, double scale) {
  const double speed = fmax(fabs(s->rate[STAGES]), fabs(s->rate[STAGES - 1]));
  double error = speed / fmax(scale, fabs(s->rate[1]));
  double impulse = fmax(s->impulse[0], fabs(s->impulse[1]));
  /* a force that bends where it begins is never that exact by its own measure, but soon by that of a plastic blow */
  if (BENDS) impulse = fmax(impulse, scale / r->contact.yields);
  error = fmax(error, fabs(s->impulse[STAGES]) / impulse);
  error *= LEFT_OUT / TOLERANCE;
#if SATURATION
  vec most = {0};
  FOR(i, V) {
    const vec of = magnitude(s->demand[STAGES][i]) / d->limit[i];
    most = choose(of > most, of, most);
  }
  FOR(l, LANES) error = fmax(error, most[l] * (LEFT_OUT / OF_LIMIT));
#endif
  return error;
}
