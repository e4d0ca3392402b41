/* Jacobians of a collision's outputs by some of its inputs, by central differences of collisions with a tight
   tolerance:

     (q, v[, feedforward], settings) -> for each output, by each of these inputs, its Jacobian

   Rows are the output's entries, by columns. Jacobians by q are in v's basis, as `integrate` moves it.

   For inputs without tangents: settings, and any input of a model with several freezes. The error is DIFFERENCE^2 / 6
   times the third derivative, plus errors of rounding and of the steps over DIFFERENCE. At a kink of the output the
   result is the mean of both slopes. */

/* Work memory; `ends` hold all outputs at both ends of a difference. */
typedef struct {
  Work collision;
  double ends[2][ENTRIES];
  double input[LONGEST], there[NQ];
} Differences;
#define WORK_TYPE Differences

static void ends_at(const double **arg, int input, const double *x, int side, Differences *w) {
  const double *in[N_IN];
  double *values[N_VALUES], *to = w->ends[side];
  Outcome c;
  FOR(k, N_IN) in[k] = arg[k];
  in[input] = x;
  FOR(i, N_VALUES) {
    values[i] = to;
    to += SIZES[i];
  }
  collide(in, values, &w->collision, &c);
  outputs_of(&c, &w->collision, values);
}

static void evaluate(const double **arg, double **res, Differences *w) {
  FOR(b, N_BY) {
    const int input = BY[b], of_q = input == ARG_q, count = of_q ? NV : SHAPES_IN[input][0] * SHAPES_IN[input][1];
    int wanted = 0;
    FOR(i, N_VALUES) wanted |= res[i * N_BY + b] != 0;
    if (!wanted) continue;
    copy_or_zero(arg[input], w->input, of_q ? NQ : count);
    FOR(direction, count) {
      double h = DIFFERENCE, displacement[NV] = {0}, *x = w->input + direction;
      const double here = *x;
      if (!of_q) {
        const double size = fmax(fabs(here), SCALES[b]);
        if (size > 0.0) h *= size;
        /* the difference as it is represented, not as it was asked for; volatile keeps the compiler from undoing it */
        volatile double ahead = here + h;
        h = ahead - here;
      }
      FOR(side, 2) {
        const double shift = side ? -h : h;
        if (of_q) {
          displacement[direction] = shift;
          const double *in[] = {w->input, displacement};
          double *out[] = {w->there};
          integrate(in, out, 0, 0, 0);
        } else *x = here + shift;
        ends_at(arg, input, of_q ? w->there : w->input, side, w);
      }
      if (!of_q) *x = here;
      long begin = 0;
      FOR(i, N_VALUES) {
        double *to = res[i * N_BY + b];
        if (to) FOR(k, SIZES[i])
          to[(long)direction * SIZES[i] + k] = (w->ends[0][begin + k] - w->ends[1][begin + k]) / (2.0 * h);
        begin += SIZES[i];
      }
    }
  }
}
