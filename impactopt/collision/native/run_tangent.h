/* Tangents from contact to separation, over the steps on the tape; see implicit_tangent.h. */

/* columns of the histories that are computed together */
#define COLUMNS_AT_ONCE 4

typedef struct {
  Linear linear;
  SeriesTangent series[ALL_VECTORS];
  StateTangent states[ALL_VECTORS], column_states[COLUMNS_AT_ONCE];
  Column columns[COLUMNS_AT_ONCE];
} RunTangent;

static void linear_of(const Data *d, const FrozenTangent *t, const State *y, const Instant *now, const Resolvent *r,
                      const Series *s, const Remainders *remainders, Linear *l) {
  l->d = d, l->frozen = t, l->begin = y, l->resolvent = r, l->series = s, l->remainders = remainders;
  FOR(j, STAGES) {
    const int term = j ? j : 1;
    const double next = j ? GAMMA_OF_STEPS : 0.0;
    FOR(i, N) l->x[i][j] = ((const double *)s->torque[term])[i] + next * ((const double *)s->torque[j + 1])[i];
    l->x[N][j] = -(s->impulse[term] + next * s->impulse[j + 1]);
  }
  FOR(i, V) {
    ((vec *)l->free)[i] = choose(not_saturated(now, i), (vec){0} + 1.0, (vec){0});
    ((vec *)l->slide)[i] = friction_slope(d, now, i);
  }
}

/* Columns of a step from `first` on, COLUMNS_AT_ONCE at most; returns their number. */
static int columns_of(const Linear *l, const Instant *now, double theta, int first, Column *columns) {
  const State *y = l->begin;
  const double h = l->resolvent->h;
  int count = 0;
  for (; count < COLUMNS_AT_ONCE && first + count < N_COLUMNS[0] - 1; count++) {
    Column *c = &columns[count];
    State then;
    c->number = first + count;
    const double part = (c->number * (EVERY * LENGTH) - y->time) / h;
    if (part >= theta) break;
    step_point(l->d, l->series, h, part, &c->place);
    instant_within(l->d, y, now, l->series, &l->resolvent->contact, part, &then, &c->at);
    contact_within(l, &then, now, &c->at, &c->contact);
    column_of(l->d, then.penetration, c);
  }
  return count;
}

/* Tangent of the state at the end of a step. */
static void step_tangent(const Linear *l, int k, double theta, const Event *e, const StepPoint *end,
                         const SeriesTangent *s, StateTangent *dy) {
  const double h = l->resolvent->h, impulse = change(l->series->impulse, end->slope);
  vec moved = either(e->kind || theta == 1.0, (vec){0}, -dy->time / h);
  if (e->kind && e->at > 0.0) moved = event_tangent(l, k, e, s, dy);
#if PEAK
  peak_tangent(l, theta, moved, s, dy);
#endif
  state_tangent(l, 1, &end, moved, s, 0, dy->demand, dy);
  dy->impulse = along(s->impulse, end->p) + impulse * moved;
  dy->time += h * moved;
}

/* Tangents of the columns and of the state at separation, for the requested vectors of directions. */
static void run_tangent(const Data *d, const FrozenTangent *t, const Tape *tape, const RecordTangent *record,
                        const int *wanted, RunTangent *w) {
  Resolvent r = {.h = 0.0};
  Instant now;
  Series s;
  Remainders remainders;
  StepPoint end;
  Linear *l = &w->linear;
  int column = 0;
  memset(w->states, 0, sizeof w->states);
#if FEEDFORWARD
  FOR(k, ALL_VECTORS) FOR(i, N) add_to_direction(&w->states[k].demand[i], k, FIRST_OF(BY_FEEDFORWARD) + i, 1.0);
#endif
  /* columns within steps are at fixed times: tangents of their times are zero */
  memset(w->column_states, 0, sizeof w->column_states);
  FOR(step, tape->made) {
    const State *y = &tape->states[step];
    const double h = tape->lengths[step], theta = tape->parts[step];
    evaluate_instant(d, y, &now);
    update_phase(d, y, &now);
    linearize_step(d, y, &now, h, &r);
    step_series(d, y, &now, &r, &remainders, &s);
#if NONLINEAR
    relinearize(d, y, &now, &r, &s, &remainders);
#endif
    linear_of(d, t, y, &now, &r, &s, &remainders, l);
    step_point(d, &s, h, theta, &end);
    for (int first = 1, more = 1; more; first = 0) {
      const int count = record ? columns_of(l, &now, theta, column, w->columns) : 0;
      const StepPoint *places[COLUMNS_AT_ONCE];
      FOR(i, count) places[i] = &w->columns[i].place;
      more = count == COLUMNS_AT_ONCE;
      column += count;
      FOR(k, ALL_VECTORS) {
        if (!wanted[k]) continue;
        if (count) prefetch(record, k, column - count, count);
        StateTangent *dy = &w->states[k];
        SeriesTangent *series = &w->series[k];
        if (first) {
          rates_tangent(t, k, &r.contact, dy);
          series_tangent(l, k, dy, series);
        }
        /* a column's time is fixed, so its place in the step moves against the step's begin */
        state_tangent(l, count, places, -dy->time / h, series, SPEEDS_OF_COLUMNS ? 0 : N, dy->demand, w->column_states);
        FOR(i, count) {
          rates_tangent(t, k, &w->columns[i].contact, &w->column_states[i]);
          write_tangent(d, t, k, &w->columns[i], &w->column_states[i], record);
        }
        if (!more) step_tangent(l, k, theta, &tape->events[step], &end, series, dy);
      }
    }
  }
  if (!record) return;

  /* the last column: after separation the force is zero, and so is its tangent */
  const State *y = &tape->states[tape->made];
  Column *last = &w->columns[0];
  evaluate_instant(d, y, &last->at);
  update_phase(d, y, &last->at);
  linearize_contact(d, y, &last->at, 0.0, ((const double *)d->frozen->Q[N])[N], &last->contact);
  if (!last->at.contact) last->contact.k = last->contact.d = 0.0;
  last->number = column;
  column_of(d, y->penetration, last);
  FOR(k, ALL_VECTORS) {
    if (!wanted[k]) continue;
    rates_tangent(t, k, &last->contact, &w->states[k]);
    write_tangent(d, t, k, last, &w->states[k], record);
  }
  repeat_tangent(record, column);
}
