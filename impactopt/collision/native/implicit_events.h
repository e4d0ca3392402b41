/* Events that end a step before its end, and the state there. */

/* Takes sign b + level as the first event where it falls below zero before the one so far. */
static void check_event(const double *b, double sign, double level, int kind, int number, Event *e) {
  double mine[TERMS], lowest = INFINITY;
  FOR(i, TERMS) {
    mine[i] = sign * b[i] + level;
    lowest = mine[i] < lowest ? mine[i] : lowest;
  }
  if (lowest >= 0.0) return;
  const double at = first_below(mine);
  if (at < e->at) *e = (Event){.at = at, .kind = kind, .number = number};
}

/* Event where a joint's series leaves |x| <= level, or returns into it. */
static void check_joint_events(const vec (*w)[V], int i, double offset, double level, int kind, Event *e) {
  double mine[TERMS], b[TERMS];
  FOR(j, TERMS) mine[j] = ((const double *)w[j])[i];
  mine[0] += offset;
  hull(mine, b);
  if (fabs(mine[0]) <= level) { /* a value at its level counts as within, as elsewhere */
    check_event(b, 1.0, level, kind, i, e);
    check_event(b, -1.0, level, kind, i, e);
  } else {
    check_event(b, mine[0] < 0.0 ? -1.0 : 1.0, -level, kind, i, e);
  }
}

/* Whether a joint's series may cross the level in this step, one joint per lane: by the size of its coefficients, and
   where these do not decide by its Bernstein hull. */
INLINE bits may_cross(const vec (*w)[V], int i, vec offset, vec level) {
  vec reach = BOUND[1] * magnitude(w[1][i]);
  for (int j = 2; j < TERMS; j++) reach += BOUND[j] * magnitude(w[j][i]);
  const vec start = w[0][i] + offset, size = magnitude(start);
  const bits open = magnitude(size - level) <= reach;
  if (!any(open)) return open;
  const bits within = size <= level, sign = (bits)start & SIGN_BIT;
  bits crosses = {0};
  for (int k = 1; k < TERMS; k++) {
    vec b = start;
    for (int j = 1; j < TERMS; j++) b += HULL[j][k] * w[j][i];
    const vec out = magnitude(b) - level, in = level - (vec)((bits)b ^ sign);
    crosses |= choose(within, out, in) > 0.0;
  }
  return crosses & open;
}

#if LAW_NONLINEAR
/* Separation function, which falls through zero at the event, and its slopes by penetration and rate. */
static void separation_at(const Data *d, const Series *s, double theta, double *found) {
  double p[TERMS];
  powers(theta, p);
  const double x = value(s->penetration, p), rate = value(s->rate, p);
  const double *in[] = {&x, &rate, d->law};
  double *out[] = {found};
  separation(in, out, 0, 0, 0);
}
/* Event of separation: first of a polynomial through the function's values at the nodes, then by Newton's method. */
static void check_separation(const Data *d, const Series *s, Event *e) {
  double w[TERMS], b[TERMS], at[3], before = 0.0, beyond = 1.0;
  double first[3];
  separation_at(d, s, 0.0, first);
  FOR(j, TERMS) w[j] = j ? 0.0 : first[0];
  FOR(i, NODES) {
    const double x = at_node(s->penetration, i), rate = at_node(s->rate, i);
    const double *in[] = {&x, &rate, d->law};
    double *out[] = {at};
    separation(in, out, 0, 0, 0);
    for (int j = 1; j < TERMS; j++) w[j] += FROM_NODES[j][i] * (at[0] - first[0]);
  }
  Event found = {.at = e->at};
  hull(w, b);
  check_event(b, 1.0, 0.0, EVENT_FORCE, 0, &found);
  if (!found.kind) return;
  double t = found.at;
  FOR(tries, 60) {
    separation_at(d, s, t, at);
    if (at[0] > 0.0) before = t;
    else beyond = t;
    double p[TERMS];
    slopes(t, p);
    const double slope = at[1] * change(s->penetration, p) + at[2] * change(s->rate, p), next = t - at[0] / slope;
    if (slope < 0.0 && fabs(next - t) <= 1e-12 * fmax(t, 1e-4)) {
      t = fmin(fmax(next, before), beyond);
      break;
    }
    t = next > before && next < beyond ? next : (before + beyond) / 2;
  }
  if (t < e->at) *e = (Event){.at = t, .kind = EVENT_FORCE};
}
#endif

/* Switching functions of the target, and their slopes by state and force. */
#if SWITCHES
typedef struct {
  double values[SWITCHES], by_z[SWITCHES * NZ1], by_force[SWITCHES];
} Switch;
static void switches_at(const Data *d, const double *z, double force, Switch *x) {
  const double *in[] = {z, &force, d->target};
  double *out[] = {x->values, x->by_z, x->by_force};
  switch_slopes(in, out, 0, 0, 0);
}
/* Switching functions at the place where a step ends. */
static void switch_in(const Data *d, const Series *s, double theta, Switch *x) {
  double p[TERMS], z[NZ1];
  powers(TARGET_NONLINEAR ? theta : 0.0, p);
  FOR(i, NZ) z[i] = value(s->target[i], p);
  switches_at(d, z, value(s->force, p), x);
}
#endif

/* Switching functions in a step, as polynomials. */
typedef struct {
#if SWITCHES
  Switch begin;
  double terms[SWITCHES][TERMS];
#else
  int none;
#endif
} Switching;
static void switching_of(const Data *d, const State *y, const Series *s, Switching *x) {
#if SWITCHES
  switches_at(d, y->target, s->force[0], &x->begin);
  FOR(k, SWITCHES) {
    double *w = x->terms[k];
    w[0] = x->begin.values[k];
    for (int j = 1; j < TERMS; j++) {
      w[j] = 0.0;
      if (TARGET_NONLINEAR) continue;
      w[j] = x->begin.by_force[k] * s->force[j];
      FOR(i, NZ) w[j] += x->begin.by_z[k + SWITCHES * i] * s->target[i][j];
    }
  }
#if TARGET_NONLINEAR
  FOR(i, NODES) {
    double z[NZ1];
    Switch there;
    FOR(k, NZ) z[k] = at_node(s->target[k], i);
    switches_at(d, z, at_node(s->force, i), &there);
    FOR(k, SWITCHES) for (int j = 1; j < TERMS; j++)
      x->terms[k][j] += FROM_NODES[j][i] * (there.values[k] - x->begin.values[k]);
  }
#endif
#endif
}
/* Error of the switching functions relative to the tolerance, which `error_of` may not see: the deflection of a board
   that vibrates slowly hardly changes the hand's speed, but decides at which vibration the board breaks. Errors are
   relative to the parts that a switch is made of. A switch by position allows less, as one that is approached slowly is
   passed much too late. */
INLINE double error_of_switches(const Resolvent *r, const Series *s, const Switching *x, double scale) {
  double error = 0.0;
#if SWITCHES
  FOR(k, SWITCHES) {
    const double *w = x->terms[k], by_force = x->begin.by_force[k];
    double place = fabs(w[0]), by_speed = 0.0;
    FOR(i, NZ) {
      const double by_z = x->begin.by_z[k + SWITCHES * i];
      place = fmax(place, fabs(by_z * s->target[i][0]));
      by_speed += by_z * r->contact.at[i];
    }
    const double rest = fmax(fabs(by_force * s->force[0]), fabs(by_speed) * scale);
    const double size = fmax(fmax(ERROR_OF_SWITCH * place, rest), fabs(w[1]));
    if (size > 0.0) error = fmax(error, fabs(w[STAGES]) / size);
  }
#endif
  return error * (LEFT_OUT / TOLERANCE);
}

static void find_event(const Data *d, const Instant *now, const Series *s, const Switching *switching, double end,
                       Event *e) {
  double b[TERMS];
  *e = (Event){.at = end};
  hull(s->rate, b);
  check_event(b, now->compressing ? 1.0 : -1.0, 0.0, EVENT_RATE, 0, e);
  if (!now->compressing) {
#if LAW_NONLINEAR
    check_separation(d, s, e);
#else
    hull(s->force, b), check_event(b, 1.0, 0.0, EVENT_FORCE, 0, e);
#endif
  }
#if SATURATION
  FOR(i, V) {
    const bits may = may_cross(s->demand, i, (vec){0}, d->limit[i]) & (bits)(d->joint_mask[i] > 0.0);
    if (any(may)) FOR(l, LANES) if (may[l])
      check_joint_events(s->demand, i * LANES + l, 0.0, d->limit[i][l], EVENT_DEMAND, e);
  }
#endif
#if FRICTION
  FOR(i, V) {
    const bits may = may_cross(s->speeds, i, d->joint_velocity[i], (vec){0} + TRANSITION) & (bits)(d->joint_mask[i] >
        0.0);
    if (any(may)) FOR(l, LANES) if (may[l])
      check_joint_events(s->speeds, i * LANES + l, d->joint_velocity[i][l], TRANSITION, EVENT_SLIDING, e);
  }
#endif
#if SWITCHES
  FOR(k, SWITCHES) {
    hull(switching->terms[k], b);
    if (b[0] != 0.0) check_event(b, b[0] < 0.0 ? -1.0 : 1.0, 0.0, EVENT_SWITCH, k, e);
    /* exactly at the switch: the target uses the piece that includes zero, which may not be the next one */
    else FOR(i, TERMS) if (b[i] != 0.0) *e = (Event){.at = 0.0, .kind = EVENT_SWITCH, .number = k};
  }
#endif
}

INLINE void move(State *y, const Series *s, double h, double theta) {
  double p[TERMS];
#if SECOND_INTEGRALS
  integrals(theta, p);
  FOR(i, V) {
    vec more = p[0] * s->torque[0][i];
    for (int j = 1; j < TERMS; j++) more += p[j] * s->torque[j][i];
    y->torque2[i] += h * more;
  }
  FOR(j, TERMS) y->impulse2 += h * p[j] * s->impulse[j];
#endif
#if PEAK
  double where;
  y->peak = largest(s->force, theta, y->peak, &where);
#endif
  powers(theta, p);
  FOR(i, V) {
    y->torque[i] = vector(s->torque, i, p);
    if (STIFFNESS) y->deviation[i] = vector(s->deviation, i, p);
  }
  y->impulse = value(s->impulse, p);
  y->penetration = value(s->penetration, p);
  FOR(i, NZ) y->target[i] = value(s->target[i], p);
  y->time += h * theta;
}
