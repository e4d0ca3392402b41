/* The loop over steps of one length; see collision/runge_kutta.py. */

/* states at the begin of all steps, for those who go back */
typedef struct {
  int made;
  State states[GRADIENT ? STEPS_AT_ALL + 1 : 1];
} Tape;

/* steps in a block of the graph's loop, which looks once more at what stands still, but not between blocks */
#define BLOCK 16

/* from y to separation, or the freeze's end; the phase at the end */
static Instant run(const Data *d, State *y, int steps, const Record *record, Tape *tape) {
  Instant now;
  int made = 0;
  for (;; made++) {
    look(d, y, &now);
    judge(d, y, &now);
    if (record && made % EVERY == 0 && made < steps) write_column(d, y, &now, record, made / EVERY);
    if (made == steps || !now.contact || !(y->time < d->until)) break;
    if (GRADIENT) tape->states[made] = *y;
    advance(d, y, &now, fmin(LENGTH, d->until - y->time));
  }
  if (GRADIENT) tape->states[made] = *y, tape->made = made;
  if (made % BLOCK) stand_still(d, y, &now);
  no_number(d, y, &now);
  if (record) {
    const int column = made < steps ? (made + EVERY - 1) / EVERY : record->columns - 1;
    write_column(d, y, &now, record, column);
    repeat_column(record, column);
  }
  return now;
}
