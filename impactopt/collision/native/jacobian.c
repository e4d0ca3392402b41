/* A collision's outputs and their Jacobians: (q, v[, feedforward], settings) -> of each output its value and, for all
   of its entries column by column, a row each, d/dq (nv) and d/dv (nv), both in v's basis. */

typedef struct {
  Work collision;
  FreezeForward freeze;
  ForwardRoom run;
} Whole;
#define ROOM Whole

static void scalars_forward(const Course *c, const Data *d, const StateTangent *dy, double **by) {
#ifdef OUT_impulse
  if (by[OUT_impulse]) put(&dy->impulse, 1, 1, 0, by[OUT_impulse]);
#endif
#ifdef OUT_peak_force
  if (by[OUT_peak_force]) put(&dy->peak, 1, 1, 0, by[OUT_peak_force]);
#endif
#ifdef OUT_duration
  if (by[OUT_duration]) put(&dy->time, 1, 1, 0, by[OUT_duration]);
#endif
#ifdef OUT_separated
  if (by[OUT_separated]) memset(by[OUT_separated], 0, NV * sizeof(double));
#endif
#ifdef OUT_energy
  double slope[NZ1] = {0}, one = 1.0;
  const double *in[] = {c->final.target, d->target, &one};
  double *out[] = {slope};
  target_energy_back(in, out, 0, 0, 0);
  vec sum[1][VD];
  FOR_EACH(k) {
    sum[0][k] = (vec){0};
    FOR(i, NZ) sum[0][k] += slope[i] * dy->target[i][k];
  }
  if (by[OUT_energy]) put(sum, 1, 1, 0, by[OUT_energy]);
#endif
}

static void evaluate(const double **arg, double **res, Whole *w) {
  Course c;
  Work *own = &w->collision;
  const Data *d = &own->data;
  double *values[N_VALUES], *by[2][N_VALUES];
  FOR(i, N_VALUES) {
    values[i] = res[3 * i];
    FOR(kind, 2) by[kind][i] = res[3 * i + 1 + kind];
  }
  collide(arg, values, own, &c);
  outputs_of(&c, own, values);

  const double *q = filled(arg[ARG_q], own->q, NQ), *v = filled(arg[ARG_v], own->v, NV);
  const double *normal = filled(arg[ARG_normal], own->normal, 3);
  const RecordTangent record = {.by = {by[BY_Q], by[BY_V]}};
  freeze_forward(q, v, normal, call(target_yield, d->target, 0, 0), &own->frozen, &w->freeze);
  run_forward(d, &w->freeze.frozen, (const vec(*)[V])w->freeze.P, &own->tape, HISTORIES ? &record : 0, &w->run);
  FOR(kind, 2) scalars_forward(&c, d, &w->run.states[kind], by[kind]);
  /* no number in, none out */
  if (c.final.impulse != c.final.impulse) FOR(kind, 2) FOR(i, N_VALUES)
    FOR(k, (ROWS[i] ? ROWS[i] * N_COLUMNS[0] : 1) * NV) if (by[kind][i]) by[kind][i][k] = NAN;
}
