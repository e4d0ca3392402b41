/* Implicit steps backwards: the discrete adjoint, for steps' lengths and phases that stay as they are.

   A name with _ is the derivative of the output by what has that name. With x_j = w_j + gamma w_(j+1) the series is

       w_(j+1) = h J x_j,    and h c on top for the first

   and going back, with b = S' a of the resolvent's transposed,

       a_j = p_j(theta) y_ + h J' b_(j+1),    a_0 the derivative by the state that the step began with

   so that v = Q (T, -p) + drift t of x_j has h (dF/dv)' b_(j+1). As in S itself only a product with X is left of
   S', and three scalars. Lengths are constants, but where an event ends the step: that is a root of the series. */

/* what a step is watched for, as a linear form of the state: of the velocity of one joint or the hand, and others */
typedef struct {
  int which;
  double velocity, deviation, penetration, target[NZ1];
} Form;

/* derivatives by the state at a place in the step */
typedef struct {
  double p[TERMS];
  Right by;
} Seed;

/* how an output changes with theta, from its derivatives by the state there */
static double by_place(const Series *s, double h, const State *y_, double theta) {
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

static void form_of(const Data *d, const State *y, const Series *s, const Contact *c, int kind, int number, Form *f) {
  double force = kind == OF_FORCE, rate = kind == OF_RATE;
  *f = (Form){.which = N};
#if SWITCHES
  if (kind == OF_SWITCH) {
    double values[SWITCHES], by_z[SWITCHES * NZ1], by_force[SWITCHES];
    const double *in[] = {y->target, &s->force[0], d->target};
    double *out[] = {values, by_z, by_force};
    switch_slopes(in, out, 0, 0, 0);
    FOR(i, NZ) f->target[i] = by_z[number + SWITCHES * i];
    force = by_force[number];
  }
#endif
  rate += c->d * force;
  f->velocity = rate;
  f->penetration = c->k * force;
  FOR(i, NZ) f->target[i] -= c->at[i] * rate;
  if (kind == OF_DEMAND) {
    f->which = number;
    f->velocity = -((const double *)d->kd)[number];
    if (STIFFNESS) f->deviation = ((const double *)d->kp)[number];
  }
  if (kind == OF_SLIDING) f->which = number, f->velocity = 1.0;
}

static double slope_of(const Form *f, const Series *s, double theta) {
  double slope[TERMS], x = 0.0;
  slopes(theta, slope);
  for (int j = 1; j < TERMS; j++) {
    double w = f->velocity * ((const double *)s->speeds[j])[f->which] + f->penetration * s->penetration[j];
    w += f->deviation * ((const double *)s->deviation[j])[f->which];
    FOR(i, NZ) w += f->target[i] * s->target[i][j];
    x += slope[j] * w;
  }
  return x;
}

/* from a form's value at theta, `value_`, back to the state there, and to what is frozen */
static void form_back(const Data *d, const State *y, const Series *s, double h, const Form *f, double value_,
                      double theta, Seed *seed, Back *all) {
  const Frozen *F = d->frozen;
  const double by = value_ * f->velocity;
  const int own = f->which;
  Right *to = &seed->by;
  powers(theta, seed->p);
  FOR(i, V) {
    to->torque[i] = by * F->Q[own][i] * d->kept[i];
    to->deviation[i] = (vec){0};
    all->Q[own][i] += by * vector(s->torque, i, seed->p);
  }
  ((double *)all->Q[own])[N] -= by * value(s->impulse, seed->p);
  to->impulse = -by * ((const double *)F->Q[own])[N];
  ((double *)to->deviation)[own] = value_ * f->deviation;
  to->penetration = value_ * f->penetration;
  FOR(i, NZ) to->target[i] = value_ * f->target[i];
  to->time = 0.0;
#if BIAS || JDOT
  to->time = by * ((const double *)F->drift)[own];
  ((double *)all->drift)[own] += by * (y->time + h * theta);
#endif
  if (own == N) all->hand_speed += by;
}

/* a becomes h J' b, b = S' a; v_ is that of h times the slope of state, torque_ is b's */
INLINE void solve_back(const Data *d, const Resolvent *r, Right *a, vec *v_, vec *torque_) {
  const Contact *c = &r->contact;
  vec s[V], x[V];
  FOR(i, V) {
    s[i] = -r->D[i] * a->torque[i];
    if (STIFFNESS) s[i] -= a->deviation[i];
    x[i] = (vec){0};
  }
  add_columns(r->X, N, (const double *)s, x);
  const double slope = c->k * r->g + c->d;
  double force_ = a->impulse - r->g * x[N / LANES][N % LANES], held[NZ1];
  FOR(i, NZ) force_ += c->moved[i] * a->target[i];
  const double rate_ = (a->penetration + slope * force_) / (1.0 + slope * r->g * c->mobility);
  force_ -= r->g * c->mobility * rate_;
  FOR(i, V) {
    x[i] += rate_ * r->X[N][i];
    v_[i] = r->h * (s[i] - r->g * r->D[i] * x[i]);
    torque_[i] = a->torque[i] + r->g * d->kept[i] * x[i];
    a->torque[i] = r->h * d->kept[i] * x[i];
    if (STIFFNESS) a->deviation[i] = r->h * r->kp[i] * torque_[i];
  }
  put_speed(v_, r->h * rate_);
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
}

INLINE void add_seed(const Seed *seed, int j, Right *a) {
  const Right *by = &seed->by;
  const double p = seed->p[j];
  FOR(i, V) {
    a->torque[i] += p * by->torque[i];
    if (STIFFNESS) a->deviation[i] += p * by->deviation[i];
  }
  a->impulse += p * by->impulse;
  a->penetration += p * by->penetration;
  FOR(i, NZ) a->target[i] += p * by->target[i];
}

/* what a step's stages add to the products' matrix */
static void products_back(const Series *s, const vec (*v_)[V], Back *all) {
  vec x[STAGES][V];
  FOR(j, STAGES) {
    FOR(i, V) x[j][i] = s->torque[j][i] + GAMMA_OF_STEPS * s->torque[j + 1][i];
    put_speed(x[j], -(s->impulse[j] + GAMMA_OF_STEPS * s->impulse[j + 1]));
  }
  FOR(c, N + 1) {
    vec more[V];
    FOR(i, V) more[i] = all->Q[c][i];
    FOR(j, STAGES) FOR(i, V) more[i] += v_[j][i] * ((const double *)x[j])[c];
    FOR(i, V) all->Q[c][i] = more[i];
  }
}

/* one step back: `y_` goes from the state after it to the one before it */
static void step_back(const Data *d, const Tape *tape, int step, Resolvent *r, State *y_, Back *all) {
  const State *y = &tape->states[step];
  const double h = tape->lengths[step], theta = tape->parts[step];
  const Event *e = &tape->events[step];
  Instant now;
  Series s;
  Seed seeds[3];
  Form form;
  int many = 1;
  look(d, y, &now);
  judge(d, y, &now);
  prepare(d, y, &now, h, r);
  make_series(d, y, &now, r, &s);

  /* where the output depends on the step's path: its end, the largest force, and the event that ends it */
  double theta_ = theta < 1.0 ? by_place(&s, h, y_, theta) : 0.0, time_ = y_->time;
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
    form_of(d, y, &s, &r->contact, OF_FORCE, 0, &form);
    form_back(d, y, &s, h, &form, y_->peak, place, &seeds[many], all);
    if (place == theta) theta_ += y_->peak * slope_of(&form, &s, theta);
    time_ += seeds[many++].by.time;
    y_->peak = 0.0;
  }
#endif
  if (e->kind && e->at > 0.0) {
    form_of(d, y, &s, &r->contact, e->kind, e->number, &form);
    const double slope = slope_of(&form, &s, e->at);
    if (slope != 0.0) {
      const double value_ = -theta_ / slope;
      form_back(d, y, &s, h, &form, value_, e->at, &seeds[many], all);
      if (e->kind == OF_SLIDING) ((double *)all->joint_velocity)[e->number] += value_;
      time_ += seeds[many++].by.time;
    }
  }
  if (!e->kind && theta < 1.0) time_ -= theta_ / h;

  /* series by series, last first */
  Right a;
  vec v_[STAGES][V], torque_[V];
  memset(&a, 0, sizeof a);
  for (int j = STAGES; j >= 0; j--) {
    if (j < STAGES) solve_back(d, r, &a, v_[j], torque_);
    FOR(k, many) add_seed(&seeds[k], j, &a);
  }
  products_back(&s, v_, all);
#if BIAS || JDOT
  time_ += dot(d->frozen->drift, v_[0], V);
  FOR(i, V) all->drift[i] += (y->time + r->g) * v_[0][i] + h * v_[1][i];
#endif
#if FRICTION
  FOR(i, V) {
    const bits sliding = magnitude(d->joint_velocity[i] + now.u[i]) > TRANSITION;
    all->joint_velocity[i] -= h * torque_[i] * (d->viscous[i] + choose(sliding, (vec){0}, d->coulomb[i] / TRANSITION));
  }
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

/* from the final state back to what is frozen */
static void run_back(const Data *d, const Tape *tape, int in_contact, State *y_, Back *all) {
  Resolvent r = {.h = 0.0};
  (void)in_contact;
  for (int i = tape->made - 1; i >= 0; i--) step_back(d, tape, i, &r, y_, all);
}
