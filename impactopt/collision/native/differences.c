/* A collision's outputs by some of its inputs, by central differences of collisions whose steps leave out next to
   nothing: (q, v[, feedforward], settings) -> of each output, by each of these inputs, its Jacobian: a row for each of
   its entries column by column, a column for each of the input's; q's are in v's basis, as `integrate` moves it.

   For what tangents do not carry: freezes on the way, whose places depend on the segments before, and settings. Left
   out is a sixth of the square of DIFFERENCE times the third derivative, and what rounding and the steps leave, over
   DIFFERENCE. Where an output has a kink between the two ends, it is the mean of both slopes. */

/* numbers of all outputs */
typedef struct {
  Work collision;
  double ends[2][ENTRIES];
  double input[LONGEST], there[NQ];
} Differences;
#define ROOM Differences

static void ends_at(const double **arg, int input, const double *x, int side, Differences *w) {
  const double *in[N_IN];
  double *values[N_VALUES], *to = w->ends[side];
  Course c;
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
    load(arg[input], w->input, of_q ? NQ : count);
    FOR(direction, count) {
      double h = DIFFERENCE, way[NV] = {0}, *x = w->input + direction;
      const double here = *x;
      if (!of_q) {
        const double size = fmax(fabs(here), SCALES[b]);
        if (size > 0.0) h *= size;
        /* what is left of it when it is added */
        volatile double ahead = here + h;
        h = ahead - here;
      }
      FOR(side, 2) {
        const double shift = side ? -h : h;
        if (of_q) {
          way[direction] = shift;
          const double *in[] = {w->input, way};
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
