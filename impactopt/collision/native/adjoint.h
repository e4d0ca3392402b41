/* Derivatives of one output by the frozen model, by the discrete adjoint of the steps. A name that ends with _ holds
   derivatives of the output by what has that name. */

typedef struct {
  vec Q[N + 1][V], drift[V], joint_velocity[V];
  double hand_speed;
} FrozenAdjoint;

/* Adjoint of `servo`: added to u_, set in deviation_. */
INLINE void servo_adjoint(const Data *d, const vec *demand_, vec *u_, vec *deviation_) {
#if KD_MATRIX
  FOR(j, N) ((double *)u_)[j] -= dot(d->kd[j], demand_, V);
#else
  FOR(i, V) u_[i] -= d->kd[i] * demand_[i];
#endif
#if STIFFNESS
#if KP_MATRIX
  FOR(i, V) deviation_[i] = (vec){0};
  FOR(j, N) ((double *)deviation_)[j] = dot(d->kp[j], demand_, V);
#else
  FOR(i, V) deviation_[i] = d->kp[i] * demand_[i];
#endif
#endif
}

INLINE void set_hand_speed(vec *u_, double speed_) { u_[N / LANES][N % LANES] = speed_; }

/* Adjoint of `velocity`: added to torque_; returns that of the impulse, negative. */
INLINE double velocity_adjoint(const Data *d, const vec *u_, vec *torque_) {
  const Frozen *F = d->frozen;
  vec a[V];
  FOR(i, V) a[i] = torque_[i];
  add_columns(F->Q, N + 1, (const double *)u_, a);
  const double force = a[N / LANES][N % LANES];
  FOR(i, V) torque_[i] = a[i] * d->joint_mask[i];
  return force;
}
