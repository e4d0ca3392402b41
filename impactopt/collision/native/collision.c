/* A collision: (q, v[, feedforward], settings) -> outputs; see collision/outputs.py. */

static void evaluate(const double **arg, double **res, Work *w) {
  Outcome outcome;
  collide(arg, res, w, &outcome);
#if !defined OUT_separated && !defined OUT_duration
  /* no other output would show that the contact has not ended */
  if (outcome.in_contact) {
    fill_with_nan(res);
    return;
  }
#endif
  outputs_of(&outcome, w, res);
}
