/* A collision's outputs and their Jacobians: (q, v[, feedforward], settings) -> of each output its value and, for all
   of its entries column by column, a row each, d/dq (nv) and d/dv (nv), both in v's basis[, d/dfeedforward (n)]. */

typedef struct {
  Work collision;
  FreezeForward freeze;
  ForwardRoom run;
} Whole;
#define ROOM Whole

static void scalars_forward(const Course *c, const Data *d, int kind, const StateTangent *dy, double **by) {
#ifdef OUT_impulse
  if (by[OUT_impulse]) put(&dy->impulse, SEEDS(kind), 1, 1, 0, by[OUT_impulse]);
#endif
#ifdef OUT_peak_force
  if (by[OUT_peak_force]) put(&dy->peak, SEEDS(kind), 1, 1, 0, by[OUT_peak_force]);
#endif
#ifdef OUT_duration
  if (by[OUT_duration]) put(&dy->time, SEEDS(kind), 1, 1, 0, by[OUT_duration]);
#endif
#ifdef OUT_separated
  if (by[OUT_separated]) memset(by[OUT_separated], 0, SEEDS(kind) * sizeof(double));
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
  if (by[OUT_energy]) put(sum, SEEDS(kind), 1, 1, 0, by[OUT_energy]);
#endif
}

static void evaluate(const double **arg, double **res, Whole *w) {
  Course c;
  Work *own = &w->collision;
  const Data *d = &own->data;
  double *values[N_VALUES], *by[KINDS][N_VALUES];
  int wanted[KINDS] = {0};
  FOR(i, N_VALUES) {
    values[i] = res[(KINDS + 1) * i];
    FOR(kind, KINDS) {
      by[kind][i] = res[(KINDS + 1) * i + 1 + kind];
      wanted[kind] |= by[kind][i] != 0;
    }
  }
  collide(arg, values, own, &c);
  outputs_of(&c, own, values);

  const double *q = filled(arg[ARG_q], own->q, NQ), *v = filled(arg[ARG_v], own->v, NV);
  const double *normal = filled(arg[ARG_normal], own->normal, 3);
  RecordTangent record;
  FOR(kind, KINDS) record.by[kind] = by[kind];
  freeze_forward(q, v, normal, call(target_yield, d->target, 0, 0), &own->frozen, &w->freeze);
  run_forward(d, &w->freeze.frozen, (const vec(*)[V])w->freeze.P, &own->tape, HISTORIES ? &record : 0,
              wanted, &w->run);
  FOR(kind, KINDS) if (wanted[kind]) scalars_forward(&c, d, kind, &w->run.states[kind], by[kind]);
  /* no number in, none out */
  if (c.final.impulse != c.final.impulse) FOR(kind, KINDS) FOR(i, N_VALUES)
    FOR(k, (ROWS[i] ? ROWS[i] * N_COLUMNS[0] : 1) * SEEDS(kind)) if (by[kind][i]) by[kind][i][k] = NAN;
}
