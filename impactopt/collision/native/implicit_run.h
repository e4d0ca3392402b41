/* Integration by implicit steps, to separation or to the end of the segment. */

/* Instant within a step; of the state only the parts that columns of histories need. */
INLINE void instant_within(const Data *d, const State *y, const Instant *now, const Series *s, const Contact *c,
                           double part, State *then, Instant *at) {
  double p[TERMS];
  powers(part, p);
  then->penetration = value(s->penetration, p);
  at->rate = value(s->rate, p);
  at->target_speed = now->target_speed;
#if TARGET_NONLINEAR
  FOR(i, NZ) then->target[i] = value(s->target[i], p);
  at->target_speed = call(target_velocity, then->target, d->target, 0);
#else
  FOR(i, NZ) for (int j = 1; j < TERMS; j++) at->target_speed += c->at[i] * p[j] * s->target[i][j];
#endif
  at->speed = at->rate + at->target_speed;
  FOR(i, V) {
    at->u[i] = vector(s->speeds, i, p);
    at->demand[i] = vector(s->demand, i, p);
  }
  torques(d, at);
}

/* Writes the columns of the histories that lie in a step; returns the number of the next one. */
static int write_columns_within(const Data *d, const State *y, const Instant *now, const Series *s, const Contact *c,
                                double h, double theta, const Record *record, int column) {
  State then;
  Instant at;
  for (;; column++) {
    const double part = (column * (EVERY * LENGTH) - y->time) / h;
    if (part >= theta || column >= record->columns - 1) return column;
    instant_within(d, y, now, s, c, part, &then, &at);
    then.time = column * (EVERY * LENGTH);
    write_column(d, &then, &at, record, column);
  }
}

/* Length [s] of the first step. */
static double first_step(const Data *d, const State *y, const Instant *now, const Contact *c, double left) {
#if LAW_NONLINEAR
  /* the force, which may begin without a slope, changes the speed by a small part */
  const double little = c->k == 0.0 && c->d == 0.0 ? FIRST_SPEED_CHANGE_FLAT : FIRST_SPEED_CHANGE;
  double h = left, law[3];
  FOR(tries, 60) {
    law_and_slopes(d, y->penetration + fabs(now->rate) * h, now->rate, now->compressing, law);
    if (fabs(law[0] - c->force) * c->mobility * h <= little * fabs(now->rate)) break;
    h /= 2;
  }
  return h;
#else
  const double rate = fmax(c->d * c->mobility, sqrt(fmax(c->k * c->mobility, 0.0)));
  return rate * left > FIRST_STEP_PHASE ? FIRST_STEP_PHASE / rate : left;
#endif
}

static Instant run(const Data *d, State *y, int steps, const Record *record, Tape *tape) {
  Instant now;
  Resolvent r = {.h = 0.0};
  Series s;
  Remainders remainders;
  Switching switching;
  Event e;
  int made = 0, column = 0, repeated = 0;
  double scale = 0.0, h = 0.0, first = 0.0;
  for (;; made++) {
    evaluate_instant(d, y, &now);
    update_phase(d, y, &now);
    if (record && !made) write_column(d, y, &now, record, column++);
    if (made == steps || !now.contact || !(y->time < d->until)) break;
    const double left = d->until - y->time;
    scale = fmax(scale, fabs(now.rate));
    if (h == 0.0) {
      linearize_contact(d, y, &now, 0.0, ((double *)d->frozen->Q[N])[N], &r.contact);
      h = first_step(d, y, &now, &r.contact, left);
    }
#if LAW_NONLINEAR
    const double to_separation = -y->penetration / now.rate;
    if (!now.compressing && to_separation > 2.0 * first) h = fmin(h, SEPARATION_FRACTION * to_separation);
#endif
    double error = 0.0;
    FOR(tries, MAX_TRIES) {
      linearize_step(d, y, &now, h, &r);
      if (!step_series(d, y, &now, &r, &remainders, &s)) {
        error = NAN;
        h *= RETRY_FACTOR;
        continue;
      }
      switching_of(d, y, &s, &switching);
      error = fmax(error_of(d, &r, &s, scale), error_of_switches(&r, &s, &switching, scale));
      if (!(error > 1.0)) break;
      h *= fmax(0.2, 0.9 * pow(error, -1.0 / TERMS));
    }
    if (error != error) {
      y->impulse = NAN;
      evaluate_instant(d, y, &now);
      break;
    }
    if (first == 0.0) first = h;
    const double end = fmin(1.0, left / h);
    find_event(d, &now, &s, &switching, end, &e);
    /* events that repeat immediately, because rounding hides that they are over: overshoot farther each time */
    repeated = e.kind && e.at < IMMEDIATE_EVENT && repeated < 8 ? repeated + 1 : 0;
    const double beyond = EVENT_OVERSHOOT * fmax(e.at, IMMEDIATE_EVENT * (1 << 3 * repeated));
    const double theta = e.kind ? fmin(end, e.at + beyond) : end;
    if (record) column = write_columns_within(d, y, &now, &s, &r.contact, h, theta, record, column);
    if (GRADIENT) {
      tape->states[made] = *y, tape->lengths[made] = h, tape->parts[made] = theta, tape->events[made] = e;
      if (theta == end) tape->events[made].kind = EVENT_NONE;
    }
    move(y, &s, h, theta);
    if (theta == end && end < 1.0) y->time = d->until;
    if (!e.kind && error < (NONLINEAR ? LENGTHEN_BELOW_NONLINEAR : LENGTHEN_BELOW) && left > 2.0 * h) {
      const double longer = pow(AIMED_ERROR / error, 1.0 / TERMS);
      h *= longer < 4.0 ? longer : 4.0;
    }
  }
  if (GRADIENT) tape->states[made] = *y, tape->made = made;
  spread_nan(d, y, &now);
  if (record) {
    column = column < record->columns ? column : record->columns - 1;
    write_column(d, y, &now, record, column);
    repeat_column(record, column);
  }
  return now;
}
