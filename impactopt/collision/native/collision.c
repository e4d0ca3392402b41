/* A collision: (q, v[, feedforward], settings) -> outputs; see collision/outputs.py. */

static void evaluate(const double **arg, double **res, Work *w) {
  Course course;
  collide(arg, res, w, &course);
  outputs_of(&course, w, res);
}
