/* Implicit steps backwards: the discrete adjoint, for steps' lengths and phases that stay as they are.

   A name with _ is the derivative of the output by what has that name. With x_j = w_j + gamma w_(j+1) the series is

       w_(j+1) = h J x_j,    and h c on top for the first

   and going back, with b = S' a of the resolvent's transposed,

       a_j = p_j(theta) y_ + h J' b_(j+1),    a_0 the derivative by the state that the step began with

   so that v = Q (T, -p) + drift t of x_j has h (dF/dv)' b_(j+1). As in S itself only a product with X is left of
   S', and three scalars. Lengths are constants, but where an event ends the step: that is a root of the series.

   What bends in law and target, n = R(o(n)), goes back by the transposed of I - dR K to what the nodes see: further
   places that an output depends on. The slopes that it is beside are constants, as the series does not depend on
   them but for its error. */

/* what a step is watched for, as a linear form of the state and n: of velocities of joints and hand, and others */
typedef struct {
  vec velocity[V], deviation[V];
  double penetration, target[NZ1], inputs[INPUTS];
} Form;

/* derivatives by the state at a place in the step */
typedef struct {
  double p[TERMS], inputs[INPUTS];
  Right by;
} Seed;
#define MOST_SEEDS (3 + (BENDS ? NODES : 0))

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

static void form_of(const Data *d, const Series *s, const Contact *c, int kind, int number, double theta, Form *f) {
  double force = kind == OF_FORCE, rate = kind == OF_RATE;
  memset(f, 0, sizeof *f);
#if SWITCHES
  if (kind == OF_SWITCH) {
    Switch x;
    switch_in(d, s, theta, &x);
    FOR(i, NZ) f->target[i] = x.by_z[number + SWITCHES * i];
    force = x.by_force[number];
  }
#endif
#if LAW_BENDS
  if (kind == OF_SEPARATION) {
    double at[3];
    separation_at(d, s, theta, at);
    f->penetration = at[1], rate = at[2];
  }
#endif
  rate += c->d * force;
  put_speed(f->velocity, rate);
  f->penetration += c->k * force;
  f->inputs[0] = force;
  if (TARGET_BENDS) f->inputs[INPUTS - 1] = -rate;
  FOR(i, NZ) f->target[i] -= c->at[i] * rate;
  if (kind == OF_DEMAND) {
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
  if (kind == OF_SLIDING) ((double *)f->velocity)[number] = 1.0;
}

static double slope_of(const Form *f, const Series *s, const Inputs n, double theta) {
  double slope[TERMS], x = 0.0;
  slopes(theta, slope);
  for (int j = 1; j < TERMS; j++) {
    double w = dot(f->velocity, s->speeds[j], V) + f->penetration * s->penetration[j];
    if (STIFFNESS) w += dot(f->deviation, s->deviation[j], V);
    FOR(i, NZ) w += f->target[i] * s->target[i][j];
    if (BENDS) FOR(a, INPUTS) w += f->inputs[a] * n[j][a];
    x += slope[j] * w;
  }
  return x;
}

/* from a form's value at theta, `value_`, back to the state there, and to what is frozen */
static void form_back(const Data *d, const State *y, const Series *s, double h, const Form *f, double value_,
                      double theta, Seed *seed, Back *all) {
  const Frozen *F = d->frozen;
  Right *to = &seed->by;
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
    FOR(i, V) to->torque[i] += by * F->Q[own][i] * d->kept[i], all->Q[own][i] += by * torque[i];
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

/* a becomes h J' b, b = S' a; v_ is that of h times the slope of state, torque_ is b's, inputs_ that of the stage's */
INLINE void solve_back(const Data *d, const Resolvent *r, Right *a, vec *v_, vec *torque_, double *inputs_) {
  const Contact *c = &r->contact;
  vec s[V], x[V], held_[V];
#if GAIN_MATRIX
  const vec(*rows)[V] = r->rows;
#else
  const vec(*rows)[V] = r->X;
#endif
  damped_back(r, a->torque, held_);
  FOR(i, V) {
    s[i] = -held_[i];
    if (STIFFNESS) s[i] -= a->deviation[i];
    x[i] = (vec){0};
  }
  add_columns(rows, N, (const double *)s, x);
  const double slope = c->k * r->g + c->d;
  double force_ = a->impulse - r->g * x[N / LANES][N % LANES], held[NZ1];
  FOR(i, NZ) force_ += c->moved[i] * a->target[i];
  const double rate_ = (a->penetration + slope * force_) / (1.0 + slope * r->g * c->mobility);
  force_ -= r->g * c->mobility * rate_;
  FOR(i, V) x[i] += rate_ * rows[N][i];
  damped_back(r, x, held_);
  FOR(i, V) {
    v_[i] = r->h * (s[i] - r->g * held_[i]);
    torque_[i] = a->torque[i] + r->g * d->kept[i] * x[i];
    a->torque[i] = r->h * d->kept[i] * x[i];
  }
#if STIFFNESS
  sprung_back(d, r, torque_, held_);
  FOR(i, V) a->deviation[i] = r->h * held_[i];
#endif
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
  inputs_[0] = r->h * force_;
#if TARGET_BENDS
  FOR(i, NZ) inputs_[1 + i] = r->h * held[i];
  inputs_[INPUTS - 1] = -r->h * rate_;
#endif
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

/* series by series, last first: from seeds to the first term */
static void stages_back(const Data *d, const Resolvent *r, const Seed *seeds, int many, Right *a, vec (*v_)[V],
                        vec *torque_, Inputs inputs_) {
  memset(a, 0, sizeof *a);
  for (int j = STAGES; j >= 0; j--) {
    double unused[INPUTS];
    if (j < STAGES) solve_back(d, r, a, v_[j], torque_, BENDS ? inputs_[j] : unused);
    FOR(k, many) add_seed(&seeds[k], j, a);
  }
}

#if BENDS
/* what depends on n as further seeds: what the nodes see; how many seeds there are then */
static int bend_back(const Data *d, const State *y, const Resolvent *r, const Series *s, const Bend *b, Seed *seeds,
                     int many, Back *all) {
  Inputs of_stage, n_;
  Right a;
  vec v_[STAGES][V], torque_[V];
  double by[UNKNOWNS];
  stages_back(d, r, seeds, many, &a, v_, torque_, of_stage);
  FOR(j, TERMS) FOR(k, INPUTS) {
    n_[j][k] = (j && j < STAGES ? of_stage[j][k] : 0.0) + (j ? GAMMA_OF_STEPS * of_stage[j - 1][k] : 0.0);
    FOR(i, many) n_[j][k] += seeds[i].p[j] * seeds[i].inputs[k];
  }
  FOR(k, INPUTS) FOR(i, NODES) {
    by[k * NODES + i] = 0.0;
    FOR(j, TERMS) by[k * NODES + i] += FROM_NODES[j][i] * n_[j][k];
  }
  solve_bend_transposed(b, by);
  FOR(i, NODES) {
    double seen_[SEEN] = {0};
    FOR(k, INPUTS) FOR(o, SEEN) seen_[o] += b->by[i][k][o] * by[k * NODES + i];
    Form f;
    memset(&f, 0, sizeof f);
    f.penetration = seen_[0];
    put_speed(f.velocity, seen_[1]);
    FOR(z, NZ) f.target[z] = (z + 2 < SEEN ? seen_[2 + z] : 0.0) - r->contact.at[z] * seen_[1];
    form_back(d, y, s, r->h, &f, 1.0, AT_NODES[i][1], &seeds[many++], all);
  }
  return many;
}
#endif

/* one step back: `y_` goes from the state after it to the one before it */
static void step_back(const Data *d, const Tape *tape, int step, Resolvent *r, State *y_, Back *all) {
  const State *y = &tape->states[step];
  const double h = tape->lengths[step], theta = tape->parts[step];
  const Event *e = &tape->events[step];
  Instant now;
  Series s;
  Bend bend;
  Seed seeds[MOST_SEEDS];
  Form form;
  int many = 1;
  look(d, y, &now);
  judge(d, y, &now);
  prepare(d, y, &now, h, r);
  series_of(d, y, &now, r, &bend, &s);
#if BENDS
  settle(d, y, &now, r, &s, &bend);
  const double(*n)[INPUTS] = (const double(*)[INPUTS])bend.n;
#else
  const double(*n)[INPUTS] = 0;
#endif
  memset(seeds[0].inputs, 0, sizeof seeds[0].inputs);

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
    form_of(d, &s, &r->contact, OF_FORCE, 0, place, &form);
    form_back(d, y, &s, h, &form, y_->peak, place, &seeds[many], all);
    if (place == theta) theta_ += y_->peak * slope_of(&form, &s, n, theta);
    time_ += seeds[many++].by.time;
    y_->peak = 0.0;
  }
#endif
  if (e->kind && e->at > 0.0) {
    const int kind = LAW_BENDS && e->kind == OF_FORCE ? OF_SEPARATION : e->kind;
    form_of(d, &s, &r->contact, kind, e->number, e->at, &form);
    const double slope = slope_of(&form, &s, n, e->at);
    if (slope != 0.0) {
      const double value_ = -theta_ / slope;
      form_back(d, y, &s, h, &form, value_, e->at, &seeds[many], all);
      if (e->kind == OF_SLIDING) ((double *)all->joint_velocity)[e->number] += value_;
      time_ += seeds[many++].by.time;
    }
  }
  if (!e->kind && theta < 1.0) time_ -= theta_ / h;

  Right a;
  vec v_[STAGES][V], torque_[V];
  Inputs of_stage;
#if BENDS
  const int before = many;
  many = bend_back(d, y, r, &s, &bend, seeds, many, all);
  for (int k = before; k < many; k++) time_ += seeds[k].by.time;
#endif
  stages_back(d, r, seeds, many, &a, v_, torque_, of_stage);
  products_back(&s, v_, all);
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

/* from the final state back to what is frozen */
static void run_back(const Data *d, const Tape *tape, int in_contact, State *y_, Back *all) {
  Resolvent r = {.h = 0.0};
  (void)in_contact;
  for (int i = tape->made - 1; i >= 0; i--) step_back(d, tape, i, &r, y_, all);
}
