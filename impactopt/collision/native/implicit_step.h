/* The stages of one step. */

typedef struct {
  vec torque[V], deviation[V];
  double impulse, penetration, time, target[NZ1];
} StageInput;

typedef struct {
  vec speeds[V];
  double impulse, penetration, rate, force, target[NZ1];
} StageSolution;

/* Solves one stage: the parts of S r that the series needs. */
INLINE void solve(const Data *d, const Resolvent *r, const StageInput *b, const double *inputs, StageSolution *x) {
  const Contact *c = &r->contact;
  vec rho[V], a[V], held[V];
  FOR(i, V) rho[i] = b->torque[i], a[i] = (vec){0};
#if STIFFNESS
  apply_stiffness(d, r, b->deviation, held);
  FOR(i, V) rho[i] += r->g * held[i];
#endif
#if BIAS || JDOT
  if (b->time != 0.0) {
    FOR(i, V) a[i] = d->frozen->drift[i] * b->time;
    apply_damping(r, a, held);
    FOR(i, V) rho[i] -= r->g * held[i];
  }
#endif
  (void)held;
  add_columns(r->X, N, (const double *)rho, a);
  const double own = ((double *)r->X[N])[N];
  double rate = a[N / LANES][N % LANES] - own * b->impulse, of_target[NZ1];
  FOR(i, NZ) {
    of_target[i] = 0.0;
    FOR(k, NZ) of_target[i] += c->inverse[i][k] * (b->target[k] + (TARGET_NONLINEAR ? r->g * inputs[1 + k] : 0.0));
    rate -= c->at[i] * of_target[i];
  }
  if (TARGET_NONLINEAR) rate -= inputs[INPUTS - 1];
  const double slope = c->k * r->g + c->d, more = NONLINEAR ? inputs[0] : 0.0;
  x->force = (c->k * b->penetration + slope * rate + more) / (1.0 + slope * r->g * c->mobility);
  x->impulse = b->impulse + r->g * x->force;
  x->rate = rate - r->g * c->mobility * x->force;
  x->penetration = b->penetration + r->g * x->rate;
  FOR(i, NZ) x->target[i] = of_target[i] + r->g * c->state_by_force[i] * x->force;
  FOR(i, V) x->speeds[i] = a[i] - r->X[N][i] * x->impulse;
}

/* Coefficients 1.. of a step's polynomials, from the right-hand side of the first stage and inputs n. */
INLINE void make_terms(const Data *d, const Resolvent *r, StageInput *b, const Inputs n, Series *s) {
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS;
  double inputs[INPUTS] = {0};
  StageSolution x;
  vec net[V], held[V];
  FOR(j, STAGES) {
    if (NONLINEAR) FOR(k, INPUTS) inputs[k] = j ? n[j][k] + GAMMA_OF_STEPS * n[j + 1][k] : n[1][k];
    if (j) {
      b->impulse = s->impulse[j];
      b->penetration = s->penetration[j];
      b->time = j == 1 ? b->time : 0.0;
      FOR(i, NZ) b->target[i] = s->target[i][j];
      FOR(i, V) b->torque[i] = s->torque[j][i], b->deviation[i] = s->deviation[j][i];
    }
    solve(d, r, b, inputs, &x);
    apply_damping(r, x.speeds, net);
    FOR(i, V) net[i] = -net[i];
#if STIFFNESS
    apply_stiffness(d, r, b->deviation, held);
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

static void make_series(const Data *d, const State *y, const Instant *now, const Resolvent *r, const Inputs n,
                        Series *s) {
  const Contact *c = &r->contact;
  const double h = r->h;
  StageInput b;
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

/* Error of a step relative to the tolerance: the size of the next coefficient of hand speed, impulse and joint demands.
   The coefficients of a speed that oscillates change sign, so one of them may be nearly zero by chance; hence the
   larger of the last two. */
INLINE double error_of(const Data *d, const Resolvent *r, const Series *s, double scale) {
  const double speed = fmax(fabs(s->rate[STAGES]), fabs(s->rate[STAGES - 1]));
  double error = speed / fmax(scale, fabs(s->rate[1]));
  double impulse = fmax(s->impulse[0], fabs(s->impulse[1]));
  /* the impulse of a plastic impact: a force like x^1.5 starts with an impulse too small to measure errors by */
  if (NONLINEAR) impulse = fmax(impulse, scale / r->contact.bare_mobility);
  error = fmax(error, fabs(s->impulse[STAGES]) / impulse);
  error *= LEFT_OUT / TOLERANCE;
#if SATURATION
  vec most = {0};
  FOR(i, V) {
    const vec of = magnitude(s->demand[STAGES][i]) / d->limit[i];
    most = choose(of > most, of, most);
  }
  FOR(l, LANES) error = fmax(error, most[l] * (LEFT_OUT / ERROR_OF_LIMIT));
#endif
  return error;
}
