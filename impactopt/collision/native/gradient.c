/* Gradient of a scalar output of a collision: (q, v[, feedforward], settings) -> value, d/dq (nv), d/dv (nv), both in
   v's basis. */

/* Value of the output (returned), and its derivatives by the final state. */
static double final_value(const Data *d, const Outcome *c, State *y_) {
  memset(y_, 0, sizeof *y_);
#if defined(OUT_impulse)
  y_->impulse = 1.0;
  return c->impulse;
#elif defined(OUT_duration)
  y_->time = 1.0;
  return c->duration;
#elif defined(OUT_peak_force)
  y_->peak = 1.0;
  return c->final.peak;
#elif defined(OUT_energy)
  double rest[NZ1] = {0}, one = 1.0;
  const double *in[] = {c->final.target, d->target, &one};
  double *out[] = {y_->target};
  target_energy_adjoint(in, out, 0, 0, 0);
  return call(target_energy, c->final.target, d->target, 0) - call(target_energy, rest, d->target, 0);
#else
  return 1.0 - c->in_contact;
#endif
}

static void evaluate(const double **arg, double **res, Work *w) {
  Outcome c;
  FrozenAdjoint all;
  State y_;
  const Data *d = &w->data;
  collide(arg, 0, w, &c);
  const double value = final_value(d, &c, &y_);
  if (res[0]) *res[0] = value;
  if (!res[1] && !res[2]) return;
  memset(&all, 0, sizeof all);
  run_adjoint(d, &w->tape, &y_, &all);

  FreezeAdjoint work;
  double by_q[NV], by_v[NV];
  const double *q = or_zeros(arg[ARG_q], w->q, NQ), *v = or_zeros(arg[ARG_v], w->v, NV);
  const double *normal = or_zeros(arg[ARG_normal], w->normal, 3);
  freeze_adjoint(q, v, normal, call(target_inverse_mass, d->target, 0, 0), &w->frozen, &all, &work, by_q, by_v);
  FOR(i, N) by_v[NV - N + i] += ((const double *)all.joint_velocity)[i];
  /* a value that is NaN has gradients that are NaN */
  FOR(i, NV) {
    if (res[1]) res[1][i] = by_q[i] + 0.0 * value;
    if (res[2]) res[2][i] = by_v[i] + 0.0 * value;
  }
}
