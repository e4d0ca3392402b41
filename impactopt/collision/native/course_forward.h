/* Tangents from contact to separation, over the steps on the tape; see implicit_forward.h. */

typedef struct {
  Linear linear;
  SeriesTangent series;
  StateTangent column;
  StateTangent states[KINDS];
} ForwardRoom;

static void linear_of(const Data *d, const FrozenTangent *t, const State *y, const Instant *now, const Resolvent *r,
                      const Series *s, const Bend *bend, Linear *l) {
  l->d = d, l->frozen = t, l->begin = y, l->resolvent = r, l->series = s, l->bend = bend;
  double x[N + 1][STAGES];
  FOR(a, STAGES) {
    FOR(j, N) x[j][a] = ((const double *)s->torque[a + 1])[j];
    x[N][a] = -s->impulse[a + 1];
  }
  times_Q(t, (const double(*)[STAGES])x, l->dQ);
  FOR(i, V) {
    ((vec *)l->free)[i] = choose(not_saturated(now, i), (vec){0} + 1.0, (vec){0});
    ((vec *)l->slide)[i] = friction_slope(d, now, i);
  }
}

/* tangents of the columns, and of the state at separation, from the steps on the tape, of the kinds that are wanted; P as in
   freeze.h */
static void run_forward(const Data *d, const FrozenTangent *t, const vec (*P)[V], const Tape *tape,
                        const RecordTangent *record, const int *wanted, ForwardRoom *w) {
  const Frozen *F = d->frozen;
  const int last = N_COLUMNS[0] - 1;
  Resolvent r = {.h = 0.0};
  Instant now, at;
  State then;
  Series s;
  Bend bend;
  Contact c;
  Linear *l = &w->linear;
  int column = 0, next;
  /* time of the columns within steps stays */
  memset(w->states, 0, sizeof w->states);
  memset(&w->column, 0, sizeof w->column);
#if FEEDFORWARD
  FOR(i, N) *lane(w->states[BY_FEEDFORWARD].demand[i], i) = 1.0;
#endif
  FOR(step, tape->made) {
    const State *y = &tape->states[step];
    const double h = tape->lengths[step], theta = tape->parts[step];
    const Event *e = &tape->events[step];
    look(d, y, &now);
    judge(d, y, &now);
    prepare(d, y, &now, h, &r);
    series_of(d, y, &now, &r, &bend, &s);
#if BENDS
    settle(d, y, &now, &r, &s, &bend);
#endif
    linear_of(d, t, y, &now, &r, &s, &bend, l);
    int after = column;
    FOR(kind, KINDS) {
      if (!wanted[kind]) continue;
      StateTangent *dy = &w->states[kind];
      vec moved[VD], back[VD];
      rates_forward(t, kind, &r.contact, dy);
      series_forward(l, kind, dy, &w->series);
      /* of a place that stays where it is in time */
      FOR_EACH(k) back[k] = -dy->time[k] / h;
      for (next = column; record && next < last; next++) {
        const double part = (next * (EVERY * LENGTH) - y->time) / h;
        if (part >= theta) break;
        within(d, y, &now, &s, &r.contact, part, &then, &at);
        state_forward(l, part, back, &w->series, SPEEDS_OF_COLUMNS ? 0 : N, &w->column);
        contact_within(l, &then, &now, &at, &c);
        rates_forward(t, kind, &c, &w->column);
        const double force = call(contact_force, &then.penetration, &at.rate, d->law);
        write_tangent(d, t, F, P, kind, &at, force, &w->column, record, next);
      }
      after = next;
      FOR_EACH(k) moved[k] = either(e->kind || theta == 1.0, (vec){0}, back[k]);
      if (e->kind && e->at > 0.0) event_forward(l, kind, e, &w->series, moved);
#if PEAK
      peak_forward(l, theta, moved, &w->series, dy);
#endif
      state_forward(l, theta, moved, &w->series, 0, dy);
      FOR_EACH(k) dy->time[k] += h * moved[k];
    }
    column = after;
  }
  if (!record) return;

  /* the end, where there is no force that could change */
  const State *y = &tape->states[tape->made];
  look(d, y, &now);
  judge(d, y, &now);
  contact_here(d, y, &now, 0.0, ((const double *)F->Q[N])[N], &r.contact);
  if (!now.contact) r.contact.k = r.contact.d = 0.0;
  const double force = call(contact_force, &y->penetration, &now.rate, d->law);
  FOR(kind, KINDS) {
    if (!wanted[kind]) continue;
    rates_forward(t, kind, &r.contact, &w->states[kind]);
    write_tangent(d, t, F, P, kind, &now, force, &w->states[kind], record, column);
  }
  repeat_tangent(record, column);
}
