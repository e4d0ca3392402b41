/* Loop over steps of constant length; see collision/runge_kutta.py. */

/* States at the begin of all steps, for the adjoint. */
typedef struct {
  int made;
  State states[GRADIENT ? STEPS_AT_ALL + 1 : 1];
} Tape;

/* Integrates y to separation, or to the end of the segment; returns the phase there. */
static Instant run(const Data *d, State *y, int steps, const Record *record, Tape *tape) {
  Instant now;
  int made = 0;
  for (;; made++) {
    evaluate_instant(d, y, &now);
    update_phase(d, y, &now);
    if (record && made % EVERY == 0 && made < steps) write_column(d, y, &now, record, made / EVERY);
    if (made == steps || !now.contact || !(y->time < d->until)) break;
    if (GRADIENT) tape->states[made] = *y;
    advance(d, y, &now, fmin(LENGTH, d->until - y->time));
  }
  if (GRADIENT) tape->states[made] = *y, tape->made = made;
  spread_nan(d, y, &now);
  if (record) {
    const int column = made < steps ? (made + EVERY - 1) / EVERY : record->columns - 1;
    write_column(d, y, &now, record, column);
    repeat_column(record, column);
  }
  return now;
}
