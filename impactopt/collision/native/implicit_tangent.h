/* Tangents of the implicit steps, for the k-th vector of directions: the same stages, with the change of J on their
   right-hand side. Lengths and phases are constants; an event that ends a step is a root of the series, and its place
   has a tangent too. A name that begins with d is the tangent of what has the rest for its name. */

/* Tangent of Series, without torques, deviations and demands, which follow from the speeds. */
typedef vec Terms[TERMS];
typedef struct {
  Terms speeds[ROWS_OF_V], impulse, penetration, rate, force, target[NZ1];
} SeriesTangent;

/* Tangent of a state and of its instant. For columns of histories the impulse is not set, and speeds only as needed. */
typedef struct {
  vec speeds[ROWS_OF_V], demand[N1], target[NZ1];
  vec impulse, penetration, time, peak, rate, force, target_speed;
} StateTangent;

/* tangents of a stage's right-hand side and of its solution */
typedef struct {
  vec torque[N1], deviation[N1], impulse, penetration, target[NZ1];
} StageInputTangent;

typedef struct {
  vec speeds[ROWS_OF_V], impulse, penetration, rate, force, target[NZ1];
} StageSolutionTangent;

/* A step and its linearization. */
typedef struct {
  const Data *d;
  const FrozenTangent *frozen;
  const Series *series;
  const Resolvent *resolvent;
  const Remainders *remainders;
  const State *begin;
  double x[N + 1][STAGES];         /* (T, -p) at which each stage evaluates the slope */
  /* per joint: 1, or 0 where saturated; slope of friction */
  double free[ROWS_OF_V] __attribute__((aligned(64))), slide[ROWS_OF_V] __attribute__((aligned(64)));
  vec model_change[STAGES][ROWS_OF_V]; /* speeds that the tangents of Q and of the drift add in each stage */
} Linear;

/* A place in a step: polynomials and their slopes there, rates of speeds and demands, and `back`: the weight of each
   coefficient of the speeds in the deviation, their integral. */
typedef struct {
  double p[TERMS], back[TERMS], slope[TERMS];
#if !GAIN_MATRIX
  double demand_by[N1][TERMS]; /* weight of each coefficient of a joint's own speed in its demand */
#endif
  vec speeds[V], demand[V];
} StepPoint;

static void step_point(const Data *d, const Series *s, double h, double theta, StepPoint *at) {
  powers(theta, at->p);
  slopes(theta, at->slope);
  FOR(i, V) {
    at->speeds[i] = changes(s->speeds, i, at->slope);
    at->demand[i] = changes(s->demand, i, at->slope);
  }
  /* deviation is minus the integral of the speed; stage j adds w_j + gamma w_(j+1), the first the begin and gamma w_1
   */
  FOR(j, TERMS) {
    at->back[j] = j ? -h * GAMMA_OF_STEPS * at->p[j] : 0.0;
    if (j < STAGES) at->back[j] -= h * at->p[j + 1];
  }
#if !GAIN_MATRIX
  FOR(i, N) FOR(j, TERMS) {
    double by = j ? -((const double *)d->kd)[i] * at->p[j] : 0.0;
    if (STIFFNESS) by += ((const double *)d->kp)[i] * at->back[j];
    at->demand_by[i][j] = by;
  }
#endif
}

/* Sets `model_change`; returns the number of stages that have one. dQ is symmetric. */
static int add_model_change(Linear *l, int k) {
  const FrozenTangent *t = l->frozen;
  const double h = l->resolvent->h;
  const int stages = k < VECTORS_OF_Q ? STAGES : k < VECTORS_OF_V ? 2 : 0;
  const vec(*Q)[COLUMNS_OF_V] = t->Q[k < VECTORS_OF_Q ? k : 0], *drift = t->drift[k];
  if (!stages) return 0;
  for (int i = 0; i <= N; i += 2) {
    vec s[2][STAGES];
    FOR(b, 2) FOR(a, STAGES) s[b][a] = either(a < 2, h * drift[i + b], (vec){0});
    if (k < VECTORS_OF_Q)
      FOR(j, N + 1) FOR(a, STAGES) FOR(b, 2) s[b][a] += l->x[j][a] * Q[i + b][j];
    FOR(b, 2) FOR(a, STAGES) l->model_change[a][i + b] = s[b][a];
  }
  return stages;
}

/* Tangents of rate and force at a state, by the linearized law and target there. */
static void rates_tangent(const FrozenTangent *t, int k, const Contact *c, StateTangent *x) {
  x->target_speed = (vec){0};
  FOR(i, NZ) x->target_speed += c->at[i] * x->target[i];
  x->rate = x->speeds[N] + t->hand_speed[k] - x->target_speed;
  x->force = c->k * x->penetration + c->d * x->rate;
}

/* out += factor times a matrix of gains times x */
INLINE void add_gain(const vec *gain, double factor, const vec *x, vec *out) {
  const double *g = (const double *)gain;
  FOR(i, N) FOR(j, N) out[i] += factor * g[j * V * LANES + i] * x[j];
}
/* out += factor times diagonal gains times x */
INLINE void add_gains(const vec *gain, double factor, const vec *x, vec *out) {
  FOR(i, N) out[i] += factor * ((const double *)gain)[i] * x[i];
}
#define ADD_KD(factor, x, out) (KD_MATRIX ? add_gain : add_gains)((const vec *)l->d->kd, factor, x, out)
#define ADD_KP(factor, x, out) (KP_MATRIX ? add_gain : add_gains)((const vec *)l->d->kp, factor, x, out)

/* out = torque + factor (kp deviation - D speeds), for the joints that are not saturated. */
INLINE void with_servo(const Linear *l, const vec *torque, double factor, const vec *speeds, const vec *deviation,
                       vec *out) {
#if GAIN_MATRIX
  vec held[N1];
  memset(held, 0, sizeof held);
#if STIFFNESS
  ADD_KP(factor, deviation, held);
#endif
  FOR(i, N) out[i] = torque[i] + l->free[i] * held[i];
  if (speeds) add_gain((const vec *)l->resolvent->D, -factor, speeds, out);
#else
  const double *D = (const double *)l->resolvent->D, *kp = (const double *)l->resolvent->kp;
  FOR(i, N) {
    vec sum = torque[i];
    if (STIFFNESS) sum += factor * kp[i] * deviation[i];
    if (speeds) sum -= factor * D[i] * speeds[i];
    out[i] = sum;
  }
#endif
}

/* tangents of the inputs n, by coefficients */
typedef vec InputsTangent[NONLINEAR ? TERMS : 1][INPUTS];

/* Solution of a stage, with `model_change` on the right-hand side. */
INLINE void solve_tangent(const Linear *l, int stage, int model_change, const StageInputTangent *b,
                          const InputsTangent n, StageSolutionTangent *x) {
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double *X = (const double *)r->X[N];
  vec rho[N1], inputs[INPUTS];
#if NONLINEAR
  FOR(a, INPUTS) inputs[a] = either(stage, n[stage][a] + GAMMA_OF_STEPS * n[stage + 1][a], n[1][a]);
#else
  memset(inputs, 0, sizeof inputs);
#endif
  const vec *of = model_change ? l->model_change[stage] : 0;
  with_servo(l, b->torque, r->g, of, b->deviation, rho);
  add_product(r->X, N, rho, of, x->speeds);
  const double slope = c->k * r->g + c->d;
  vec rate = x->speeds[N] - X[N] * b->impulse, held[NZ1];
  FOR(i, NZ) {
    held[i] = (vec){0};
    FOR(j, NZ) held[i] += c->inverse[i][j] * b->target[j];
    if (TARGET_NONLINEAR) FOR(j, NZ) held[i] += c->inverse[i][j] * r->g * inputs[1 + j];
    rate -= c->at[i] * held[i];
  }
  if (TARGET_NONLINEAR) rate -= inputs[INPUTS - 1];
  x->force = (c->k * b->penetration + slope * rate + inputs[0]) / (1.0 + slope * r->g * c->mobility);
  const vec impulse = x->impulse = b->impulse + r->g * x->force;
  x->rate = rate - r->g * c->mobility * x->force;
  x->penetration = b->penetration + r->g * x->rate;
  FOR(i, NZ) x->target[i] = held[i] + r->g * c->state_by_force[i] * x->force;
  FOR(i, N + 1) x->speeds[i] -= X[i] * impulse;
}

/* Tangents of all coefficients, from that of the state at the begin. */
static void terms_tangent(const Linear *l, int k, int stages, const StateTangent *dy, const InputsTangent n,
                          SeriesTangent *s) {
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS;
  StageInputTangent b;
  StageSolutionTangent x;
  FOR(i, N + 1) s->speeds[i][0] = dy->speeds[i];
  FOR(i, N) {
    b.torque[i] = h * (l->free[i] * dy->demand[i] - l->slide[i] * dy->speeds[i]);
    b.deviation[i] = -h * dy->speeds[i];
  }
  if (FRICTION) FOR(i, N) add_to_direction(&b.torque[i], k, FIRST_OF(BY_V) + NV - N + i, -h * l->slide[i]);
  s->impulse[0] = dy->impulse;
  s->penetration[0] = dy->penetration;
  s->rate[0] = dy->rate;
  s->force[0] = dy->force;
  b.impulse = h * dy->force;
  b.penetration = h * dy->rate;
  FOR(i, NZ) {
    s->target[i][0] = dy->target[i];
    vec rate = c->G[i] * dy->force;
    FOR(j, NZ) rate += c->Z[i][j] * dy->target[j];
    b.target[i] = h * rate;
  }
  FOR(j, STAGES) {
    solve_tangent(l, j, j < stages, &b, n, &x);
    /* the first stage keeps its right-hand side and adds to it; others replace it */
    const double by = j ? h : r->g, before = j != 0, of = j ? by_gamma : 1.0;
    if (j) memset(b.torque, 0, sizeof b.torque);
    with_servo(l, b.torque, by, x.speeds, b.deviation, b.torque);
    FOR(i, N + 1) {
      const vec v = x.speeds[i];
      s->speeds[i][j + 1] = (v - before * s->speeds[i][j]) * of;
      if (i < N) b.deviation[i] = either(j, (vec){0}, b.deviation[i]) - by * v;
    }
    b.impulse = s->impulse[j + 1] = either(j, h * x.force, x.impulse);
    b.penetration = s->penetration[j + 1] = either(j, h * x.rate, x.penetration);
    FOR(i, NZ) b.target[i] = s->target[i][j + 1] = (x.target[i] - before * s->target[i][j]) * of;
    s->rate[j + 1] = (x.rate - before * s->rate[j]) * of;
    s->force[j + 1] = (x.force - before * s->force[j]) * of;
  }
}

#if NONLINEAR
/* Tangents of n, from those of the series for a fixed n. */
static void remainders_tangent(const Remainders *b, const SeriesTangent *s, InputsTangent n) {
  double at[LANES][UNKNOWNS];
  FOR(i, NODES) {
    vec observed[OBSERVED];
    FOR(o, OBSERVED) {
      observed[o] = (vec){0};
      FOR(j, TERMS) {
        const vec w = o == 0 ? s->penetration[j] : o == 1 ? s->rate[j] : s->target[(o - 2) % NZ1][j];
        observed[o] += AT_NODES[i][j] * w;
      }
    }
    FOR(lane, LANES) FOR(a, INPUTS) {
      double x = 0.0;
      FOR(o, OBSERVED) x += b->by[i][a][o] * observed[o][lane];
      at[lane][a * NODES + i] = x;
    }
  }
  memset(n, 0, sizeof(InputsTangent));
  FOR(lane, LANES) {
    solve_remainders(b, at[lane]);
    FOR(j, TERMS) FOR(a, INPUTS) FOR(i, NODES)
      n[j][a][lane] += FROM_NODES[j][i] * at[lane][a * NODES + i];
  }
}
#endif

static void series_tangent(Linear *l, int k, const StateTangent *dy, SeriesTangent *s) {
  InputsTangent n;
  memset(n, 0, sizeof n);
  const int stages = add_model_change(l, k);
  terms_tangent(l, k, stages, dy, (const vec(*)[INPUTS])n, s);
#if NONLINEAR
  remainders_tangent(l->remainders, s, n);
  terms_tangent(l, k, stages, dy, (const vec(*)[INPUTS])n, s);
#endif
}

/* ------------------------------------------------------------ places within a step */
/* Law and target, linearized at an instant within a step. */
static void contact_within(const Linear *l, const State *then, const Instant *now, const Instant *at, Contact *c) {
  *c = l->resolvent->contact;
#if LAW_NONLINEAR
  double law[3];
  law_and_slopes(l->d, then->penetration, at->rate, now->compressing, law);
  c->k = law[1], c->d = law[2];
#endif
#if TARGET_NONLINEAR
  double Z[NZ * NZ], G[NZ1];
  const double force = 0.0, *in[] = {then->target, &force, l->d->target};
  double *out[] = {Z, G, c->at};
  target_slopes(in, out, 0, 0, 0);
#endif
}

INLINE vec along(const Terms w, const double *p) {
  vec s = w[0];
  for (int j = 1; j < TERMS; j++) s += p[j] * w[j];
  return s;
}

/* Tangents of the demands at places, from those at the begin; all places move by `moved`. */
static void demands_tangent(const Linear *l, int count, const StepPoint *const *places, vec moved,
                            const SeriesTangent *t, const vec *begin, StateTangent *x) {
#if GAIN_MATRIX
  FOR(a, count) {
    const StepPoint *at = places[a];
    vec speeds[N1], deviation[N1], *demand = x[a].demand;
    FOR(i, N) {
      speeds[i] = along(t->speeds[i], at->p) - t->speeds[i][0];
      deviation[i] = (vec){0};
      FOR(j, TERMS) deviation[i] += at->back[j] * t->speeds[i][j];
      demand[i] = begin[i] + ((const double *)at->demand)[i] * moved;
    }
    ADD_KD(-1.0, speeds, demand);
#if STIFFNESS
    ADD_KP(1.0, deviation, demand);
#endif
  }
#else
  FOR(i, N) {
    const vec b = begin[i];
    vec w[TERMS];
    FOR(j, TERMS) w[j] = t->speeds[i][j];
    FOR(a, count) {
      vec s = b + ((const double *)places[a]->demand)[i] * moved;
      FOR(j, TERMS) s += places[a]->demand_by[i][j] * w[j];
      x[a].demand[i] = s;
    }
  }
#endif
}

/* Tangent of the event's place in the step. */
static vec event_tangent(const Linear *l, int k, const Event *e, const SeriesTangent *t, const StateTangent *dy) {
  const Series *s = l->series;
  const int i = e->number;
  double p[TERMS], slope[TERMS], along_step = 0.0, by_force = 0.0;
  powers(e->at, p);
  slopes(e->at, slope);
  vec moved = {0};
  if (e->kind == EVENT_RATE) {
    along_step = change(s->rate, slope);
    moved = along(t->rate, p);
  } else if (e->kind == EVENT_DEMAND) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->demand[j])[i];
    StateTangent there;
    StepPoint place;
    const StepPoint *places[] = {&place};
    step_point(l->d, s, l->resolvent->h, e->at, &place);
    demands_tangent(l, 1, places, moved, t, dy->demand, &there);
    moved = there.demand[i];
  } else if (e->kind == EVENT_SLIDING) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->speeds[j])[i];
    moved = along(t->speeds[i], p);
    add_to_direction(&moved, k, FIRST_OF(BY_V) + NV - N + i, 1.0);
  } else if (e->kind == EVENT_FORCE) {
#if LAW_NONLINEAR
    double at[3];
    separation_at(l->d, s, e->at, at);
    along_step = at[1] * change(s->penetration, slope) + at[2] * change(s->rate, slope);
    moved = at[1] * along(t->penetration, p) + at[2] * along(t->rate, p);
#else
    by_force = 1.0;
#endif
  }
#if SWITCHES
  if (e->kind == EVENT_SWITCH) {
    Switch x;
    switch_in(l->d, s, e->at, &x);
    by_force = x.by_force[i];
    FOR(z, NZ) {
      const double by = x.by_z[i + SWITCHES * z];
      along_step += by * change(s->target[z], slope);
      moved += by * along(t->target[z], p);
    }
  }
#endif
  if (by_force != 0.0) {
    along_step += by_force * change(s->force, slope);
    moved += by_force * along(t->force, p);
  }
  return either(along_step != 0.0, -moved / along_step, (vec){0});
}

/* Tangents of the states at places that all move by `moved`; speeds from joint `first` on; not of impulse, time and
   peak. */
INLINE void state_tangent(const Linear *l, int count, const StepPoint *const *places, vec moved, const SeriesTangent *t,
                          int first, const vec *demand, StateTangent *x) {
#define ALONG(row, by) { \
    vec w_[TERMS]; \
    memcpy(w_, t->row, sizeof w_); \
    FOR(a, count) { \
      const StepPoint *at = places[a]; \
      vec s_ = w_[0] + (by) * moved; \
      for (int j = 1; j < TERMS; j++) s_ += at->p[j] * w_[j]; \
      x[a].row = s_; \
    } \
  }
  for (int i = first; i <= N; i++) ALONG(speeds[i], ((const double *)at->speeds)[i])
  ALONG(penetration, change(l->series->penetration, at->slope))
  FOR(i, NZ) ALONG(target[i], change(l->series->target[i], at->slope))
#undef ALONG
  demands_tangent(l, count, places, moved, t, demand, x);
}

#if PEAK
static void peak_tangent(const Linear *l, double theta, vec moved, const SeriesTangent *t, StateTangent *dy) {
  double p[TERMS], slope[TERMS], place;
  if (!(l->begin->peak < largest(l->series->force, theta, l->begin->peak, &place))) return;
  powers(place, p);
  slopes(place, slope);
  const double at_end = place == theta ? change(l->series->force, slope) : 0.0;
  dy->peak = along(t->force, p) + at_end * moved;
}
#endif
