/* A collision: (q, v[, feedforward], settings) -> outputs; see collision/outputs.py. */

static void evaluate(const double **arg, double **res, Work *w) {
  Course course;
  collide(arg, res, w, &course);
#if !defined OUT_separated && !defined OUT_duration
  /* nothing else would tell that it is not over */
  if (course.in_contact) {
    no_numbers(res);
    return;
  }
#endif
  outputs_of(&course, w, res);
}
