/* Outputs of a collision and their Jacobians: (q, v[, feedforward], settings) -> for each output its value, d/dq (nv),
   d/dv (nv), both in v's basis[, and d/dfeedforward (n)]; rows of a Jacobian are the output's entries, by columns. */

typedef struct {
  Work collision;
  FreezeTangent freeze;
  RecordTangent record;
  RunTangent run;
} JacobianWork;
#define WORK_TYPE JacobianWork

/* Tangents of the scalar outputs, for the k-th vector of directions. */
static void scalars_tangent(const Outcome *c, const Data *d, int k, const StateTangent *dy,
                            const RecordTangent *record) {
#define PUT_NUMBER(name, x) write_entries(x, 1, 0, record->to[OUT_##name] + k * LANES)
#ifdef OUT_impulse
  PUT_NUMBER(impulse, &dy->impulse);
#endif
#ifdef OUT_peak_force
  PUT_NUMBER(peak_force, &dy->peak);
#endif
#ifdef OUT_duration
  PUT_NUMBER(duration, &dy->time);
#endif
#ifdef OUT_separated
  const vec none = {0};
  PUT_NUMBER(separated, &none);
#endif
#ifdef OUT_energy
  double slope[NZ1] = {0}, one = 1.0;
  const double *in[] = {c->final.target, d->target, &one};
  double *out[] = {slope};
  target_energy_adjoint(in, out, 0, 0, 0);
  vec sum = {0};
  FOR(i, NZ) sum += slope[i] * dy->target[i];
  PUT_NUMBER(energy, &sum);
#endif
}

static void evaluate(const double **arg, double **res, JacobianWork *w) {
  Outcome c;
  Work *own = &w->collision;
  RecordTangent *record = &w->record;
  const Data *d = &own->data;
  double *values[N_VALUES];
  int wanted[ALL_VECTORS] = {0};
  memset(record, 0, sizeof *record);
  FOR(i, N_VALUES) {
    const long entries = ROWS[i] ? ROWS[i] * N_COLUMNS[0] : 1;
    values[i] = res[(KINDS + 1) * i];
    FOR(kind, KINDS) {
      double *by = res[(KINDS + 1) * i + 1 + kind];
      if (by) FOR(seed, SEEDS(kind)) {
        const int direction = FIRST_OF(kind) + seed;
        record->to[i][direction] = by + seed * entries;
        wanted[direction / LANES] = 1;
      }
    }
  }
  collide(arg, values, own, &c);
  outputs_of(&c, own, values);

  const double *q = or_zeros(arg[ARG_q], own->q, NQ), *v = or_zeros(arg[ARG_v], own->v, NV);
  const double *normal = or_zeros(arg[ARG_normal], own->normal, 3);
  freeze_tangent(q, v, normal, call(target_inverse_mass, d->target, 0, 0), &own->frozen, wanted,
                 &w->freeze);
  run_tangent(d, &w->freeze.frozen, &own->tape, HISTORIES ? record : 0, wanted, &w->run);
  FOR(k, ALL_VECTORS) if (wanted[k]) scalars_tangent(&c, d, k, &w->run.states[k], record);
  /* a collision that is NaN has Jacobians that are NaN */
  if (c.final.impulse != c.final.impulse) FOR(i, N_VALUES) FOR(direction, ALL_VECTORS * LANES)
    FOR(k, ROWS[i] ? ROWS[i] * N_COLUMNS[0] : 1) if (record->to[i][direction]) record->to[i][direction][k] = NAN;
}
