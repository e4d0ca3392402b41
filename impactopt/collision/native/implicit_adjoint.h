/* Discrete adjoint of the implicit steps, for fixed lengths and phases. A name with _ is the derivative of the output
   by what has that name. With x_j = w_j + gamma w_(j+1) the series is

       w_(j+1) = h J x_j,    and h c on top for the first

   and its adjoint, with b = S' a of the transposed resolvent, is

       a_j = p_j(theta) y_ + h J' b_(j+1),    a_0 the derivative by the state that the step began with

   so that v = Q (T, -p) + drift t of x_j has h (dF/dv)' b_(j+1). As S itself, S' needs one product with X and three
   scalars. An event that ends a step is a root of the series, and its place has derivatives too.

   The remainders of nonlinear laws and targets, n = R(o(n)), have the transposed of I - dR K; it gives derivatives by
   the observations at the nodes, as further seeds. The slopes at the step's begin count as constants: the series
   depends on them only through its error. */

/* Event function as a linear form of the state and n; `velocity` is of joints and hand. */
typedef struct {
  vec velocity[V], deviation[V];
  double penetration, target[NZ1], inputs[INPUTS];
} EventForm;

/* Derivatives by the state at a place in the step. */
typedef struct {
  double p[TERMS], inputs[INPUTS];
  StageInput by;
} Seed;
#define MAX_SEEDS (3 + (NONLINEAR ? NODES : 0))

/* Derivative of an output by theta, from its derivatives by the state there. */
static double derivative_along_step(const Series *s, double h, const State *y_, double theta) {
  double slope[TERMS];
  vec found = {0};
  slopes(theta, slope);
  FOR(i, V) {
    found += y_->torque[i] * changes(s->torque, i, slope);
    if (STIFFNESS) found += y_->deviation[i] * changes(s->deviation, i, slope);
  }
  double x = sum(found) + y_->impulse * change(s->impulse, slope) + y_->penetration * change(s->penetration, slope);
  FOR(i, NZ) x += y_->target[i] * change(s->target[i], slope);
  return x + y_->time * h;
}

static void event_form(const Data *d, const Series *s, const Contact *c, int kind, int number, double theta,
                       EventForm *f) {
  double force = kind == EVENT_FORCE, rate = kind == EVENT_RATE;
  memset(f, 0, sizeof *f);
#if SWITCHES
  if (kind == EVENT_SWITCH) {
    Switch x;
    switch_in(d, s, theta, &x);
    FOR(i, NZ) f->target[i] = x.by_z[number + SWITCHES * i];
    force = x.by_force[number];
  }
#endif
#if LAW_NONLINEAR
  if (kind == EVENT_SEPARATION) {
    double at[3];
    separation_at(d, s, theta, at);
    f->penetration = at[1], rate = at[2];
  }
#endif
  rate += c->d * force;
  set_hand_speed(f->velocity, rate);
  f->penetration += c->k * force;
  f->inputs[0] = force;
  if (TARGET_NONLINEAR) f->inputs[INPUTS - 1] = -rate;
  FOR(i, NZ) f->target[i] -= c->at[i] * rate;
  if (kind == EVENT_DEMAND) {
#if KD_MATRIX
    FOR(j, N) ((double *)f->velocity)[j] = -((const double *)d->kd[j])[number];
#else
    ((double *)f->velocity)[number] = -((const double *)d->kd)[number];
#endif
#if STIFFNESS && KP_MATRIX
    FOR(j, N) ((double *)f->deviation)[j] = ((const double *)d->kp[j])[number];
#elif STIFFNESS
    ((double *)f->deviation)[number] = ((const double *)d->kp)[number];
#endif
  }
  if (kind == EVENT_SLIDING) ((double *)f->velocity)[number] = 1.0;
}

static double slope_of(const EventForm *f, const Series *s, const Inputs n, double theta) {
  double slope[TERMS], x = 0.0;
  slopes(theta, slope);
  for (int j = 1; j < TERMS; j++) {
    double w = dot(f->velocity, s->speeds[j], V) + f->penetration * s->penetration[j];
    if (STIFFNESS) w += dot(f->deviation, s->deviation[j], V);
    FOR(i, NZ) w += f->target[i] * s->target[i][j];
    if (NONLINEAR) FOR(a, INPUTS) w += f->inputs[a] * n[j][a];
    x += slope[j] * w;
  }
  return x;
}

/* From the derivative by an event function's value to those by the state at theta, and by the frozen model. */
static void event_form_adjoint(const Data *d, const State *y, const Series *s, double h, const EventForm *f,
                               double value_, double theta, Seed *seed, FrozenAdjoint *all) {
  const Frozen *F = d->frozen;
  StageInput *to = &seed->by;
  vec torque[V];
  powers(theta, seed->p);
  FOR(i, V) {
    torque[i] = vector(s->torque, i, seed->p);
    to->torque[i] = (vec){0};
    to->deviation[i] = value_ * f->deviation[i];
  }
  const double impulse = value(s->impulse, seed->p);
  to->impulse = to->time = 0.0;
  FOR(own, N + 1) {
    const double by = value_ * ((const double *)f->velocity)[own];
    if (by == 0.0) continue;
    FOR(i, V) to->torque[i] += by * F->Q[own][i] * d->joint_mask[i], all->Q[own][i] += by * torque[i];
    ((double *)all->Q[own])[N] -= by * impulse;
    to->impulse -= by * ((const double *)F->Q[own])[N];
#if BIAS || JDOT
    to->time += by * ((const double *)F->drift)[own];
    ((double *)all->drift)[own] += by * (y->time + h * theta);
#endif
    if (own == N) all->hand_speed += by;
  }
  to->penetration = value_ * f->penetration;
  FOR(i, NZ) to->target[i] = value_ * f->target[i];
  FOR(a, INPUTS) seed->inputs[a] = value_ * f->inputs[a];
}

/* a := h J' b with b = S' a. Also sets v_ (by the velocity in h times the slope of the state), torque_ (that of b) and
   inputs_ (by the stage's inputs). */
INLINE void solve_adjoint(const Data *d, const Resolvent *r, StageInput *a, vec *v_, vec *torque_, double *inputs_) {
  const Contact *c = &r->contact;
  vec s[V], x[V], held_[V];
#if GAIN_MATRIX
  const vec(*rows)[V] = r->rows;
#else
  const vec(*rows)[V] = r->X;
#endif
  apply_damping_transposed(r, a->torque, held_);
  FOR(i, V) {
    s[i] = -held_[i];
    if (STIFFNESS) s[i] -= a->deviation[i];
    x[i] = (vec){0};
  }
  add_columns(rows, N, (const double *)s, x);
  const double slope = c->k * r->g + c->d;
  double force_ = a->impulse - r->g * x[N / LANES][N % LANES], held[NZ1];
  FOR(i, NZ) force_ += c->state_by_force[i] * a->target[i];
  const double rate_ = (a->penetration + slope * force_) / (1.0 + slope * r->g * c->mobility);
  force_ -= r->g * c->mobility * rate_;
  FOR(i, V) x[i] += rate_ * rows[N][i];
  apply_damping_transposed(r, x, held_);
  FOR(i, V) {
    v_[i] = r->h * (s[i] - r->g * held_[i]);
    torque_[i] = a->torque[i] + r->g * d->joint_mask[i] * x[i];
    a->torque[i] = r->h * d->joint_mask[i] * x[i];
  }
#if STIFFNESS
  apply_stiffness_transposed(d, r, torque_, held_);
  FOR(i, V) a->deviation[i] = r->h * held_[i];
#endif
  set_hand_speed(v_, r->h * rate_);
  a->impulse = -r->h * x[N / LANES][N % LANES];
  a->penetration = r->h * c->k * force_;
  FOR(i, NZ) {
    held[i] = 0.0;
    FOR(k, NZ) held[i] += c->inverse[k][i] * (a->target[k] - r->g * c->at[k] * rate_);
  }
  FOR(i, NZ) {
    a->target[i] = -r->h * c->at[i] * rate_;
    FOR(k, NZ) a->target[i] += r->h * c->Z[k][i] * held[k];
  }
  inputs_[0] = r->h * force_;
#if TARGET_NONLINEAR
  FOR(i, NZ) inputs_[1 + i] = r->h * held[i];
  inputs_[INPUTS - 1] = -r->h * rate_;
#endif
}

INLINE void add_seed(const Seed *seed, int j, StageInput *a) {
  const StageInput *by = &seed->by;
  const double p = seed->p[j];
  FOR(i, V) {
    a->torque[i] += p * by->torque[i];
    if (STIFFNESS) a->deviation[i] += p * by->deviation[i];
  }
  a->impulse += p * by->impulse;
  a->penetration += p * by->penetration;
  FOR(i, NZ) a->target[i] += p * by->target[i];
}

/* Adds the derivatives by Q from the stages of a step. */
static void inertia_adjoint(const Series *s, const vec (*v_)[V], FrozenAdjoint *all) {
  vec x[STAGES][V];
  FOR(j, STAGES) {
    FOR(i, V) x[j][i] = s->torque[j][i] + GAMMA_OF_STEPS * s->torque[j + 1][i];
    set_hand_speed(x[j], -(s->impulse[j] + GAMMA_OF_STEPS * s->impulse[j + 1]));
  }
  FOR(c, N + 1) {
    vec more[V];
    FOR(i, V) more[i] = all->Q[c][i];
    FOR(j, STAGES) FOR(i, V) more[i] += v_[j][i] * ((const double *)x[j])[c];
    FOR(i, V) all->Q[c][i] = more[i];
  }
}

/* Adjoint of the stages, last first: from seeds to the first coefficient. */
static void stages_adjoint(const Data *d, const Resolvent *r, const Seed *seeds, int many, StageInput *a, vec (*v_)[V],
                           vec *torque_, Inputs inputs_) {
  memset(a, 0, sizeof *a);
  for (int j = STAGES; j >= 0; j--) {
    double unused[INPUTS];
    if (j < STAGES) solve_adjoint(d, r, a, v_[j], torque_, NONLINEAR ? inputs_[j] : unused);
    FOR(k, many) add_seed(&seeds[k], j, a);
  }
}

#if NONLINEAR
/* Adds the observations at the nodes as seeds, where the step depends on n; returns the number of seeds. */
static int remainders_adjoint(const Data *d, const State *y, const Resolvent *r, const Series *s, const Remainders *b,
                              Seed *seeds, int many, FrozenAdjoint *all) {
  Inputs of_stage, n_;
  StageInput a;
  vec v_[STAGES][V], torque_[V];
  double by[UNKNOWNS];
  stages_adjoint(d, r, seeds, many, &a, v_, torque_, of_stage);
  FOR(j, TERMS) FOR(k, INPUTS) {
    n_[j][k] = (j && j < STAGES ? of_stage[j][k] : 0.0) + (j ? GAMMA_OF_STEPS * of_stage[j - 1][k] : 0.0);
    FOR(i, many) n_[j][k] += seeds[i].p[j] * seeds[i].inputs[k];
  }
  FOR(k, INPUTS) FOR(i, NODES) {
    by[k * NODES + i] = 0.0;
    FOR(j, TERMS) by[k * NODES + i] += FROM_NODES[j][i] * n_[j][k];
  }
  solve_remainders_transposed(b, by);
  FOR(i, NODES) {
    double seen_[OBSERVED] = {0};
    FOR(k, INPUTS) FOR(o, OBSERVED) seen_[o] += b->by[i][k][o] * by[k * NODES + i];
    EventForm f;
    memset(&f, 0, sizeof f);
    f.penetration = seen_[0];
    set_hand_speed(f.velocity, seen_[1]);
    FOR(z, NZ) f.target[z] = (z + 2 < OBSERVED ? seen_[2 + z] : 0.0) - r->contact.at[z] * seen_[1];
    event_form_adjoint(d, y, s, r->h, &f, 1.0, AT_NODES[i][1], &seeds[many++], all);
  }
  return many;
}
#endif

/* Adjoint of one step: y_, by the state after it, becomes that by the state before it. */
static void step_adjoint(const Data *d, const Tape *tape, int step, Resolvent *r, State *y_, FrozenAdjoint *all) {
  const State *y = &tape->states[step];
  const double h = tape->lengths[step], theta = tape->parts[step];
  const Event *e = &tape->events[step];
  Instant now;
  Series s;
  Remainders remainders;
  Seed seeds[MAX_SEEDS];
  EventForm form;
  int many = 1;
  evaluate_instant(d, y, &now);
  update_phase(d, y, &now);
  linearize_step(d, y, &now, h, r);
  step_series(d, y, &now, r, &remainders, &s);
#if NONLINEAR
  relinearize(d, y, &now, r, &s, &remainders);
  const double(*n)[INPUTS] = (const double(*)[INPUTS])remainders.n;
#else
  const double(*n)[INPUTS] = 0;
#endif
  memset(seeds[0].inputs, 0, sizeof seeds[0].inputs);

  /* where the output depends on the step's path: its end, the largest force, and the event that ends it */
  double theta_ = theta < 1.0 ? derivative_along_step(&s, h, y_, theta) : 0.0, time_ = y_->time;
  powers(theta, seeds[0].p);
  FOR(i, V) {
    seeds[0].by.torque[i] = y_->torque[i];
    seeds[0].by.deviation[i] = STIFFNESS ? y_->deviation[i] : (vec){0};
  }
  seeds[0].by.impulse = y_->impulse;
  seeds[0].by.penetration = y_->penetration;
  FOR(i, NZ) seeds[0].by.target[i] = y_->target[i];
#if PEAK
  double place;
  if (y_->peak != 0.0 && y->peak < largest(s.force, theta, y->peak, &place)) {
    event_form(d, &s, &r->contact, EVENT_FORCE, 0, place, &form);
    event_form_adjoint(d, y, &s, h, &form, y_->peak, place, &seeds[many], all);
    if (place == theta) theta_ += y_->peak * slope_of(&form, &s, n, theta);
    time_ += seeds[many++].by.time;
    y_->peak = 0.0;
  }
#endif
  if (e->kind && e->at > 0.0) {
    const int kind = LAW_NONLINEAR && e->kind == EVENT_FORCE ? EVENT_SEPARATION : e->kind;
    event_form(d, &s, &r->contact, kind, e->number, e->at, &form);
    const double slope = slope_of(&form, &s, n, e->at);
    if (slope != 0.0) {
      const double value_ = -theta_ / slope;
      event_form_adjoint(d, y, &s, h, &form, value_, e->at, &seeds[many], all);
      if (e->kind == EVENT_SLIDING) ((double *)all->joint_velocity)[e->number] += value_;
      time_ += seeds[many++].by.time;
    }
  }
  if (!e->kind && theta < 1.0) time_ -= theta_ / h;

  StageInput a;
  vec v_[STAGES][V], torque_[V];
  Inputs of_stage;
#if NONLINEAR
  const int before = many;
  many = remainders_adjoint(d, y, r, &s, &remainders, seeds, many, all);
  for (int k = before; k < many; k++) time_ += seeds[k].by.time;
#endif
  stages_adjoint(d, r, seeds, many, &a, v_, torque_, of_stage);
  inertia_adjoint(&s, v_, all);
#if BIAS || JDOT
  time_ += dot(d->frozen->drift, v_[0], V);
  FOR(i, V) all->drift[i] += (y->time + r->g) * v_[0][i] + h * v_[1][i];
#endif
#if FRICTION
  FOR(i, V) all->joint_velocity[i] -= h * torque_[i] * friction_slope(d, &now, i);
#endif
  all->hand_speed += v_[0][N / LANES][N % LANES];
  FOR(i, V) {
    y_->torque[i] = a.torque[i];
    if (STIFFNESS) y_->deviation[i] = a.deviation[i];
  }
  y_->impulse = a.impulse;
  y_->penetration = a.penetration;
  y_->time = time_;
  FOR(i, NZ) y_->target[i] = a.target[i];
}

/* From derivatives by the final state to derivatives by the frozen model. */
static void run_adjoint(const Data *d, const Tape *tape, State *y_, FrozenAdjoint *all) {
  Resolvent r = {.h = 0.0};
  for (int i = tape->made - 1; i >= 0; i--) step_adjoint(d, tape, i, &r, y_, all);
}
