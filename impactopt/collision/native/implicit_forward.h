/* Tangents of the implicit steps, one step after the other: the same stages with what J changes by on their right-hand
   side. Lengths and phases are constants; where an event ends the step, the part of it that was gone is a root of the
   series, and moves with it. A name that begins with d is the tangent of what has the rest for its name. */

typedef struct {
  vec torque[N1][VD], deviation[N1][VD], impulse[VD], penetration[VD], time[VD], peak[VD], target[NZ1][VD];
} StateTangent;

/* of Series, without what only the state needs */
typedef struct {
  vec speeds[TERMS][ROWS_OF_V][VD], demand[TERMS][N1][VD];
  vec impulse[TERMS][VD], penetration[TERMS][VD], rate[TERMS][VD], force[TERMS][VD], target[TERMS][NZ1][VD];
} SeriesTangent;

/* of the right-hand side of a stage, and what it gives */
typedef struct {
  vec torque[N1][VD], deviation[N1][VD], impulse[VD], penetration[VD], target[NZ1][VD];
} RightTangent;

typedef struct {
  vec speeds[ROWS_OF_V][VD], impulse[VD], penetration[VD], rate[VD], force[VD], target[NZ1][VD];
} LeftTangent;

/* of a step: what it is made of */
typedef struct {
  const Data *d;
  const FrozenTangent *frozen;
  const Series *series;
  const Resolvent *resolvent;
  const State *begin;
  vec dQ[TERMS][N + 1][VD]; /* times (T, -p) of each term */
  double slope[ROWS_OF_V], slide[ROWS_OF_V], kp[ROWS_OF_V]; /* of the joints' net torque */
} Linear;

/* dQ times `count` vectors, which are the columns of x */
INLINE void times_Q(const FrozenTangent *t, const double (*x)[TERMS], int count, vec (*out)[N + 1][VD]) {
  const int width = (N + 1) * VD;
  FOR(m, width) {
    vec s[TERMS];
    FOR(a, count) s[a] = (vec){0};
    FOR(j, N + 1) {
      const vec of = t->Q[j][0][m];
      FOR(a, count) s[a] += x[j][a] * of;
    }
    FOR(a, count) out[a][0][m] = s[a];
  }
}

/* as `look` sees it, and the forces that come with it; dQ has dQ (T, -p) */
static void look_forward(const Data *d, const FrozenTangent *t, int kind, const State *y, const StateTangent *dy,
                         const Contact *c, const vec (*dQ)[VD], InstantTangent *x) {
  const Frozen *F = d->frozen;
  FOR(i, ROWS_OF_V) FOR_EACH(k) x->speeds[i][k] = (vec){0};
  if (kind == BY_Q) FOR(i, N + 1) FOR_EACH(k) x->speeds[i][k] = dQ[i][k];
  add_product(F->Q, N, dy->torque[0], VD, x->speeds[0]);
  const double *by = (const double *)F->Q[N], *drift = (const double *)F->drift;
  FOR(i, N + 1) FOR_EACH(k) {
    x->speeds[i][k] -= by[i] * dy->impulse[k];
#if BIAS || JDOT
    x->speeds[i][k] += t->drift[kind][i][k] * y->time + drift[i] * dy->time[k];
#endif
  }
  const double *kd = (const double *)d->kd, *kp = (const double *)d->kp;
  FOR(i, N) FOR_EACH(k) {
    x->demand[i][k] = -kd[i] * x->speeds[i][k];
    if (STIFFNESS) x->demand[i][k] += kp[i] * dy->deviation[i][k];
  }
  FOR_EACH(k) {
    x->time[k] = dy->time[k];
    x->target_speed[k] = (vec){0};
    FOR(i, NZ) x->target_speed[k] += c->at[i] * dy->target[i][k];
    x->rate[k] = x->speeds[N][k] + t->hand_speed[kind][k] - x->target_speed[k];
    x->penetration[k] = dy->penetration[k];
    x->force[k] = c->k * x->penetration[k] + c->d * x->rate[k];
  }
}

/* S b, with dJ's part on the right-hand side: dQ of both terms that this stage is made of, the drift's over `time` */
INLINE void solve_forward(const Linear *l, int kind, int stage, double time, const RightTangent *b, LeftTangent *x) {
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double *D = (const double *)r->D, *X = (const double *)r->X[N];
  vec rho[N1][VD];
  FOR(i, ROWS_OF_V) FOR_EACH(k) {
    vec a = {0};
    if (kind == BY_Q && i <= N) {
      a = l->dQ[stage ? stage : 1][i][k];
      if (stage) a += GAMMA_OF_STEPS * l->dQ[stage + 1][i][k];
    }
#if BIAS || JDOT
    if (time != 0.0 && i <= N) a += l->frozen->drift[kind][i][k] * time;
#endif
    x->speeds[i][k] = a;
    if (i < N) {
      rho[i][k] = b->torque[i][k] - r->g * D[i] * a;
      if (STIFFNESS) rho[i][k] += r->g * l->kp[i] * b->deviation[i][k];
    }
  }
  add_product(r->X, N, rho[0], VD, x->speeds[0]);
  const double slope = c->k * r->g + c->d;
  FOR_EACH(k) {
    vec rate = x->speeds[N][k] - X[N] * b->impulse[k], held[NZ1];
    FOR(i, NZ) {
      held[i] = (vec){0};
      FOR(j, NZ) held[i] += c->inverse[i][j] * b->target[j][k];
      rate -= c->at[i] * held[i];
    }
    x->force[k] = (c->k * b->penetration[k] + slope * rate) / (1.0 + slope * r->g * c->mobility);
    x->impulse[k] = b->impulse[k] + r->g * x->force[k];
    x->rate[k] = rate - r->g * c->mobility * x->force[k];
    x->penetration[k] = b->penetration[k] + r->g * x->rate[k];
    FOR(i, NZ) x->target[i][k] = held[i] + r->g * c->moved[i] * x->force[k];
  }
  FOR(i, N + 1) FOR_EACH(k) x->speeds[i][k] -= X[i] * x->impulse[k];
}

/* the tangents of all terms; the state's torque and deviation become those at the part with p */
static void series_forward(const Linear *l, int kind, const double *p, StateTangent *dy, SeriesTangent *s) {
  const Data *d = l->d;
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS, *kd = (const double *)d->kd, *kp = (const double *)d->kp;
  const double *D = (const double *)r->D;
  InstantTangent now;
  RightTangent b;
  LeftTangent x;
  look_forward(d, l->frozen, kind, l->begin, dy, c, l->dQ[0], &now);
  memcpy(s->speeds[0], now.speeds, sizeof now.speeds);
  memcpy(s->demand[0], now.demand, sizeof now.demand);
  FOR(i, N) FOR_EACH(k) {
    vec net = -l->slope[i] * now.speeds[i][k];
    if (STIFFNESS) net += l->kp[i] * dy->deviation[i][k];
    b.torque[i][k] = h * net;
    b.deviation[i][k] = -h * now.speeds[i][k];
  }
  if (FRICTION && kind == BY_V) FOR(i, N) *lane(b.torque[i], NV - N + i) -= h * l->slide[i];
  FOR_EACH(k) {
    s->impulse[0][k] = dy->impulse[k];
    s->penetration[0][k] = now.penetration[k];
    s->rate[0][k] = now.rate[k];
    s->force[0][k] = now.force[k];
    b.impulse[k] = h * now.force[k];
    b.penetration[k] = h * now.rate[k];
    FOR(i, NZ) {
      s->target[0][i][k] = dy->target[i][k];
      vec rate = c->G[i] * now.force[k];
      FOR(j, NZ) rate += c->Z[i][j] * dy->target[j][k];
      b.target[i][k] = h * rate;
    }
  }
  FOR(j, STAGES) {
    solve_forward(l, kind, j, j < 2 ? h : 0.0, &b, &x);
    FOR(i, N) FOR_EACH(k) {
      vec v = x.speeds[i][k], net = -D[i] * v;
      if (STIFFNESS && j) net += l->kp[i] * b.deviation[i][k];
      if (j) {
        b.torque[i][k] = h * net;
        b.deviation[i][k] = -h * v;
        v = (v - s->speeds[j][i][k]) * by_gamma;
      } else {
        b.torque[i][k] += r->g * net;
        if (STIFFNESS) b.torque[i][k] += r->g * l->kp[i] * b.deviation[i][k];
        b.deviation[i][k] -= r->g * v;
      }
      s->speeds[j + 1][i][k] = v;
      s->demand[j + 1][i][k] = -kd[i] * v;
      dy->torque[i][k] += p[j + 1] * b.torque[i][k];
      if (STIFFNESS) {
        s->demand[j + 1][i][k] += kp[i] * b.deviation[i][k];
        dy->deviation[i][k] += p[j + 1] * b.deviation[i][k];
      }
    }
    FOR_EACH(k) {
      b.impulse[k] = s->impulse[j + 1][k] = either(j, h * x.force[k], x.impulse[k]);
      b.penetration[k] = s->penetration[j + 1][k] = either(j, h * x.rate[k], x.penetration[k]);
      FOR(i, NZ) {
        const vec z = either(j, (x.target[i][k] - s->target[j][i][k]) * by_gamma, x.target[i][k]);
        b.target[i][k] = s->target[j + 1][i][k] = z;
      }
      s->rate[j + 1][k] = either(j, (x.rate[k] - s->rate[j][k]) * by_gamma, x.rate[k]);
      s->force[j + 1][k] = either(j, (x.force[k] - s->force[j][k]) * by_gamma, x.force[k]);
    }
  }
}

/* ------------------------------------------------------------ places within a step */
INLINE vec along(const vec *w, long stride, const double *p) {
  vec s = w[0];
  for (int j = 1; j < TERMS; j++) s += p[j] * w[j * stride];
  return s;
}
#define ALONG(w, ...) along(&(w)[0] __VA_ARGS__, (&(w)[1] __VA_ARGS__) - (&(w)[0] __VA_ARGS__), p)

/* how the event's place moves */
static void event_forward(const Linear *l, int kind, const Event *e, const SeriesTangent *t, vec *moved) {
  const Series *s = l->series;
  const int i = e->number;
  double p[TERMS], slope[TERMS], along_step = 0.0, by_force = 0.0;
  powers(e->at, p);
  slopes(e->at, slope);
  FOR_EACH(k) moved[k] = (vec){0};
  if (e->kind == OF_RATE) {
    along_step = change(s->rate, slope);
    FOR_EACH(k) moved[k] = ALONG(t->rate, [k]);
  } else if (e->kind == OF_DEMAND) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->demand[j])[i];
    FOR_EACH(k) moved[k] = ALONG(t->demand, [i][k]);
  } else if (e->kind == OF_SLIDING) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->speeds[j])[i];
    FOR_EACH(k) moved[k] = ALONG(t->speeds, [i][k]);
    if (kind == BY_V) *lane(moved, NV - N + i) += 1.0;
  } else if (e->kind == OF_FORCE) {
    by_force = 1.0;
  }
#if SWITCHES
  if (e->kind == OF_SWITCH) {
    double values[SWITCHES], by_z[SWITCHES * NZ1], by_forces[SWITCHES];
    const double *in[] = {l->begin->target, &s->force[0], l->d->target};
    double *out[] = {values, by_z, by_forces};
    switch_slopes(in, out, 0, 0, 0);
    by_force = by_forces[i];
    FOR(z, NZ) {
      const double by = by_z[i + SWITCHES * z];
      along_step += by * change(s->target[z], slope);
      FOR_EACH(k) moved[k] += by * ALONG(t->target, [z][k]);
    }
  }
#endif
  if (by_force != 0.0) {
    along_step += by_force * change(s->force, slope);
    FOR_EACH(k) moved[k] += by_force * ALONG(t->force, [k]);
  }
  FOR_EACH(k) moved[k] = either(along_step != 0.0, -moved[k] / along_step, (vec){0});
}

/* an instant of the step, at a part of it that moves by dpart */
static void instant_forward(const Linear *l, double part, const vec *dpart, const SeriesTangent *t,
                            InstantTangent *x) {
  const Series *s = l->series;
  const Contact *c = &l->resolvent->contact;
  double p[TERMS], slope[TERMS];
  powers(part, p);
  slopes(part, slope);
  FOR(i, SPEEDS_OF_COLUMNS ? N : 0) {
    double speed = 0.0;
    for (int j = 1; j < TERMS; j++) speed += slope[j] * ((const double *)s->speeds[j])[i];
    FOR_EACH(k) x->speeds[i][k] = ALONG(t->speeds, [i][k]) + speed * dpart[k];
  }
  FOR(i, N) {
    double demand = 0.0;
    for (int j = 1; j < TERMS; j++) demand += slope[j] * ((const double *)s->demand[j])[i];
    FOR_EACH(k) x->demand[i][k] = ALONG(t->demand, [i][k]) + demand * dpart[k];
  }
  FOR_EACH(k) {
    x->penetration[k] = ALONG(t->penetration, [k]) + change(s->penetration, slope) * dpart[k];
    x->rate[k] = ALONG(t->rate, [k]) + change(s->rate, slope) * dpart[k];
    x->force[k] = c->k * x->penetration[k] + c->d * x->rate[k];
    x->target_speed[k] = x->time[k] = (vec){0};
    FOR(i, NZ) x->target_speed[k] += c->at[i] * (ALONG(t->target, [i][k]) + change(s->target[i], slope) * dpart[k]);
  }
}

/* the state's tangent to the end of the step; torque and deviation are there but for the end's own motion */
static void move_forward(const Linear *l, double theta, const vec *moved, const SeriesTangent *t, StateTangent *dy) {
  const Series *s = l->series;
  double p[TERMS], slope[TERMS];
#if PEAK
  double place;
  if (l->begin->peak < largest(s->force, theta, l->begin->peak, &place)) {
    powers(place, p);
    slopes(place, slope);
    const double at_end = place == theta ? change(s->force, slope) : 0.0;
    FOR_EACH(k) dy->peak[k] = ALONG(t->force, [k]) + at_end * moved[k];
  }
#endif
  powers(theta, p);
  slopes(theta, slope);
  FOR(i, N) {
    double torque = 0.0, deviation = 0.0;
    for (int j = 1; j < TERMS; j++) {
      torque += slope[j] * ((const double *)s->torque[j])[i];
      deviation += slope[j] * ((const double *)s->deviation[j])[i];
    }
    FOR_EACH(k) {
      dy->torque[i][k] += torque * moved[k];
      if (STIFFNESS) dy->deviation[i][k] += deviation * moved[k];
    }
  }
  FOR_EACH(k) {
    dy->impulse[k] = ALONG(t->impulse, [k]) + change(s->impulse, slope) * moved[k];
    dy->penetration[k] = ALONG(t->penetration, [k]) + change(s->penetration, slope) * moved[k];
    FOR(i, NZ) dy->target[i][k] = ALONG(t->target, [i][k]) + change(s->target[i], slope) * moved[k];
    dy->time[k] += l->resolvent->h * moved[k];
  }
}

/* ------------------------------------------------------------ from contact to separation */
typedef struct {
  Linear linear;
  SeriesTangent series;
  InstantTangent instant;
  StateTangent states[2];
} ForwardRoom;

/* products of a state's or a term's torque and impulse with dQ, and the slopes of the net torque */
static void linear_of(const Data *d, const FrozenTangent *t, const State *y, const Instant *now, const Resolvent *r,
                      const Series *s, Linear *l) {
  l->d = d, l->frozen = t, l->begin = y, l->resolvent = r, l->series = s;
  double x[N + 1][TERMS];
  FOR(a, TERMS) {
    FOR(j, N) x[j][a] = ((const double *)s->torque[a])[j];
    x[N][a] = -s->impulse[a];
  }
  times_Q(t, (const double(*)[TERMS])x, TERMS, l->dQ);
  FOR(i, V) {
    const bits free_ = now->torque[i] == now->demand[i];
    vec slope = SATURATION ? (vec)((bits)d->kd[i] & free_) : d->kd[i], slide = {0};
#if FRICTION
    const bits sliding = magnitude(d->joint_velocity[i] + now->u[i]) > TRANSITION;
    slide = d->viscous[i] + choose(sliding, (vec){0}, d->coulomb[i] / TRANSITION);
#endif
    FOR(a, LANES) {
      l->slope[i * LANES + a] = slope[a] + slide[a];
      l->slide[i * LANES + a] = slide[a];
      l->kp[i * LANES + a] = r->kp[i][a];
    }
  }
}

/* tangents of all columns, and of the state at separation, from the steps on the tape; P as in freeze.h */
static void run_forward(const Data *d, const FrozenTangent *t, const vec (*P)[V], const Tape *tape,
                        const RecordTangent *record, ForwardRoom *w) {
  const Frozen *F = d->frozen;
  const int last = N_COLUMNS[0] - 1;
  Resolvent r = {.h = 0.0};
  Instant now, at;
  State then;
  Series s;
  Linear *l = &w->linear;
  int column = 0, next = 0;
  memset(w->states, 0, sizeof w->states);
  FOR(step, tape->made) {
    const State *y = &tape->states[step];
    const double h = tape->lengths[step], theta = tape->parts[step];
    const Event *e = &tape->events[step];
    double p[TERMS];
    look(d, y, &now);
    judge(d, y, &now);
    prepare(d, y, &now, h, &r);
    make_series(d, y, &now, &r, &s);
    linear_of(d, t, y, &now, &r, &s, l);
    powers(theta, p);
    FOR(kind, 2) {
      StateTangent *dy = &w->states[kind];
      vec moved[VD], back[VD];
      series_forward(l, kind, p, dy, &w->series);
      /* of a place that stays where it is in time */
      FOR_EACH(k) back[k] = -dy->time[k] / h;
      for (next = column; record && next < last; next++) {
        const double part = (next * (EVERY * LENGTH) - y->time) / h;
        if (part >= theta) break;
        within(d, y, &now, &s, &r.contact, part, &then, &at);
        instant_forward(l, part, back, &w->series, &w->instant);
        const double force = call(contact_force, &then.penetration, &at.rate, d->law);
        write_tangent(d, t, F, P, kind, &at, force, &w->instant, record, next);
      }
      FOR_EACH(k) moved[k] = either(e->kind || theta == 1.0, (vec){0}, back[k]);
      if (e->kind && e->at > 0.0) event_forward(l, kind, e, &w->series, moved);
      move_forward(l, theta, moved, &w->series, dy);
    }
    column = next;
  }
  if (!record) return;

  /* the end, where there is no force that could change */
  const State *y = &tape->states[tape->made];
  look(d, y, &now);
  judge(d, y, &now);
  contact_here(d, y, &now, 0.0, ((const double *)F->Q[N])[N], &r.contact);
  if (!now.contact) r.contact.k = r.contact.d = 0.0;
  double x[N + 1][TERMS];
  FOR(j, N) x[j][0] = ((const double *)y->torque)[j];
  x[N][0] = -y->impulse;
  times_Q(t, (const double(*)[TERMS])x, 1, l->dQ);
  const double force = call(contact_force, &y->penetration, &now.rate, d->law);
  FOR(kind, 2) {
    look_forward(d, t, kind, y, &w->states[kind], &r.contact, (const vec(*)[VD])l->dQ[0], &w->instant);
    write_tangent(d, t, F, P, kind, &now, force, &w->instant, record, column);
  }
  repeat_tangent(record, column);
}
