/* Tangents from contact to separation, over the steps on the tape; see implicit_forward.h. */

/* columns within a step that are made at once */
#define SOME 4

typedef struct {
  Linear linear;
  SeriesTangent series[ALL_VECTORS];
  StateTangent states[ALL_VECTORS], seen[SOME];
  Column columns[SOME];
} ForwardRoom;

static void linear_of(const Data *d, const FrozenTangent *t, const State *y, const Instant *now, const Resolvent *r,
                      const Series *s, const Bend *bend, Linear *l) {
  l->d = d, l->frozen = t, l->begin = y, l->resolvent = r, l->series = s, l->bend = bend;
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

/* columns of a step from `first` on, SOME at most; how many */
static int columns_of(const Linear *l, const Instant *now, double theta, int first, Column *columns) {
  const State *y = l->begin;
  const double h = l->resolvent->h;
  int count = 0;
  for (; count < SOME && first + count < N_COLUMNS[0] - 1; count++) {
    Column *c = &columns[count];
    State then;
    c->number = first + count;
    const double part = (c->number * (EVERY * LENGTH) - y->time) / h;
    if (part >= theta) break;
    place_of(l->d, l->series, h, part, &c->place);
    within(l->d, y, now, l->series, &l->resolvent->contact, part, &then, &c->at);
    contact_within(l, &then, now, &c->at, &c->contact);
    column_of(l->d, then.penetration, c);
  }
  return count;
}

/* tangents at the end of a step */
static void step_forward(const Linear *l, int k, double theta, const Event *e, const Place *end, const SeriesTangent *s,
                         StateTangent *dy) {
  const double h = l->resolvent->h, impulse = change(l->series->impulse, end->slope);
  vec moved = either(e->kind || theta == 1.0, (vec){0}, -dy->time / h);
  if (e->kind && e->at > 0.0) moved = event_forward(l, k, e, s, dy);
#if PEAK
  peak_forward(l, theta, moved, s, dy);
#endif
  state_forward(l, 1, &end, moved, s, 0, dy->demand, dy);
  dy->impulse = along(s->impulse, end->p) + impulse * moved;
  dy->time += h * moved;
}

/* tangents of the columns, and of the state at separation, from the steps on the tape, of the vectors of directions that
   are wanted */
static void run_forward(const Data *d, const FrozenTangent *t, const Tape *tape, const RecordTangent *record,
                        const int *wanted, ForwardRoom *w) {
  Resolvent r = {.h = 0.0};
  Instant now;
  Series s;
  Bend bend;
  Place end;
  Linear *l = &w->linear;
  int column = 0;
  memset(w->states, 0, sizeof w->states);
#if FEEDFORWARD
  FOR(k, ALL_VECTORS) FOR(i, N) add_to_direction(&w->states[k].demand[i], k, FIRST_OF(BY_FEEDFORWARD) + i, 1.0);
#endif
  /* time of the columns within steps stays */
  memset(w->seen, 0, sizeof w->seen);
  FOR(step, tape->made) {
    const State *y = &tape->states[step];
    const double h = tape->lengths[step], theta = tape->parts[step];
    look(d, y, &now);
    judge(d, y, &now);
    prepare(d, y, &now, h, &r);
    series_of(d, y, &now, &r, &bend, &s);
#if BENDS
    settle(d, y, &now, &r, &s, &bend);
#endif
    linear_of(d, t, y, &now, &r, &s, &bend, l);
    place_of(d, &s, h, theta, &end);
    for (int first = 1, more = 1; more; first = 0) {
      const int count = record ? columns_of(l, &now, theta, column, w->columns) : 0;
      const Place *places[SOME];
      FOR(i, count) places[i] = &w->columns[i].place;
      more = count == SOME;
      column += count;
      FOR(k, ALL_VECTORS) {
        if (!wanted[k]) continue;
        if (count) fetch(record, k, column - count, count);
        StateTangent *dy = &w->states[k];
        SeriesTangent *series = &w->series[k];
        if (first) {
          rates_forward(t, k, &r.contact, dy);
          series_forward(l, k, dy, series);
        }
        /* of a place that stays where it is in time */
        state_forward(l, count, places, -dy->time / h, series, SPEEDS_OF_COLUMNS ? 0 : N, dy->demand, w->seen);
        FOR(i, count) {
          rates_forward(t, k, &w->columns[i].contact, &w->seen[i]);
          write_tangent(d, t, k, &w->columns[i], &w->seen[i], record);
        }
        if (!more) step_forward(l, k, theta, &tape->events[step], &end, series, dy);
      }
    }
  }
  if (!record) return;

  /* the end, where there is no force that could change */
  const State *y = &tape->states[tape->made];
  Column *last = &w->columns[0];
  look(d, y, &last->at);
  judge(d, y, &last->at);
  contact_here(d, y, &last->at, 0.0, ((const double *)d->frozen->Q[N])[N], &last->contact);
  if (!last->at.contact) last->contact.k = last->contact.d = 0.0;
  last->number = column;
  column_of(d, y->penetration, last);
  FOR(k, ALL_VECTORS) {
    if (!wanted[k]) continue;
    rates_forward(t, k, &last->contact, &w->states[k]);
    write_tangent(d, t, k, last, &w->states[k], record);
  }
  repeat_tangent(record, column);
}
