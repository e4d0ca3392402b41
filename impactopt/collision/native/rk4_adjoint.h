/* Discrete adjoint of the Runge-Kutta steps, for fixed phases of the contact. */

/* Adds to y_ the derivatives by the state that a slope was evaluated at. */
static void slope_adjoint(const Data *d, const State *y, const Instant *now, double force, const Slope *s_, State *y_,
                          FrozenAdjoint *all) {
  double by_z[NZ1], force_, x_, rate_, by_state[NZ1];
  const double *in[] = {y->target, &force, d->target, s_->target};
  double *out[] = {by_z, &force_};
  target_rates_adjoint(in, out, 0, 0, 0);
  force_ += s_->impulse;
  const double *of_law[] = {&y->penetration, &now->rate, d->law, &force_};
  double *by_law[] = {&x_, &rate_};
  contact_force_adjoint(of_law, by_law, 0, 0, 0);
  rate_ += s_->penetration;
  const double *of_target[] = {y->target, d->target, &rate_};
  double *by_target[] = {by_state};
  target_velocity_adjoint(of_target, by_target, 0, 0, 0);
  FOR(i, NZ) y_->target[i] += by_z[i] - by_state[i];
  y_->penetration += x_;

  vec u_[V], demand_[V], deviation_[V], torque_[V];
  FOR(i, V) {
    u_[i] = (vec){0};
    if (STIFFNESS) u_[i] -= s_->deviation[i];
    const vec net_ = s_->torque[i];
#if FRICTION
    const bits sliding = magnitude(d->joint_velocity[i] + now->u[i]) > TRANSITION;
    const vec by_rate = -net_ * (d->viscous[i] + choose(sliding, (vec){0}, d->coulomb[i] / TRANSITION));
    u_[i] += by_rate;
    all->joint_velocity[i] += by_rate;
#endif
    demand_[i] = SATURATION ? (vec)((bits)net_ & (now->torque[i] == now->demand[i])) : net_;
    torque_[i] = y_->torque[i];
  }
  servo_adjoint(d, demand_, u_, deviation_);
  if (STIFFNESS) FOR(i, V) y_->deviation[i] += deviation_[i];
  set_hand_speed(u_, rate_);
  y_->impulse -= velocity_adjoint(d, u_, torque_);
  FOR(i, V) y_->torque[i] = torque_[i];
#if BIAS || JDOT
  y_->time += dot(d->frozen->drift, u_, V);
  FOR(i, V) all->drift[i] += y->time * u_[i];
#endif
  all->hand_speed += rate_;
  FOR(c, N + 1) {
    const double x = c < N ? ((const double *)y->torque)[c] : -y->impulse;
    FOR(i, V) all->Q[c][i] += u_[i] * x;
  }
}

INLINE void scaled(const State *y_, double factor, Slope *s_) {
  FOR(i, V) {
    s_->torque[i] = y_->torque[i] * factor;
    if (STIFFNESS) s_->deviation[i] = y_->deviation[i] * factor;
  }
  s_->penetration = y_->penetration * factor;
  s_->impulse = y_->impulse * factor;
  FOR(i, NZ) s_->target[i] = y_->target[i] * factor;
}
/* s_ += factor y_ */
INLINE void add_scaled(const State *y_, double factor, Slope *s_) {
  FOR(i, V) {
    s_->torque[i] += y_->torque[i] * factor;
    if (STIFFNESS) s_->deviation[i] += y_->deviation[i] * factor;
  }
  s_->penetration += y_->penetration * factor;
  s_->impulse += y_->impulse * factor;
  FOR(i, NZ) s_->target[i] += y_->target[i] * factor;
}
INLINE double along(const State *y_, const Slope *s) {
  double value = y_->penetration * s->penetration + y_->impulse * s->impulse + y_->time;
  value += dot(y_->torque, s->torque, V);
  if (STIFFNESS) value += dot(y_->deviation, s->deviation, V);
  FOR(i, NZ) value += y_->target[i] * s->target[i];
  return value;
}
INLINE void add(State *y_, const State *more) {
  FOR(i, V) {
    y_->torque[i] += more->torque[i];
    if (STIFFNESS) y_->deviation[i] += more->deviation[i];
  }
  y_->time += more->time;
  y_->penetration += more->penetration;
  y_->impulse += more->impulse;
  FOR(i, NZ) y_->target[i] += more->target[i];
}

static void step_adjoint(const Data *d, const State *y, State *y_, FrozenAdjoint *all) {
  const double left = d->until - y->time, h = fmin(LENGTH, left);
  const double shares[] = {0.0, h / 2, h / 2, h}, weights[] = {h / 6, h / 3, h / 3, h / 6};
  Slope k[4], k_[4];
  State at[4], at_;
  Instant now[4];
  at[0] = *y;
  FOR(i, 4) {
    if (i) add_slope(y, &k[i - 1], shares[i], &at[i]);
    evaluate_instant(d, &at[i], &now[i]);
    slope_at(d, &at[i], &now[i], &k[i]);
  }
  double h_ = 0.0;
  FOR(i, 4) h_ += (along(y_, &k[i])) * (weights[i] / h);
  FOR(i, 4) scaled(y_, weights[i], &k_[i]);
#if PEAK
  if (y->peak < k[0].impulse) k_[0].impulse += y_->peak, y_->peak = 0.0;
#endif
  State total = *y_;
  for (int i = 3; i >= 0; i--) {
    memset(&at_, 0, sizeof at_);
    slope_adjoint(d, &at[i], &now[i], k[i].impulse, &k_[i], &at_, all);
    add(&total, &at_);
    if (i) {
      add_scaled(&at_, shares[i], &k_[i - 1]);
      h_ += along(&at_, &k[i - 1]) * (shares[i] / h);
    }
  }
  if (left < LENGTH) total.time -= h_;
  *y_ = total;
}

/* From derivatives by the final state to derivatives by the frozen model. */
static void run_adjoint(const Data *d, const Tape *tape, State *y_, FrozenAdjoint *all) {
  for (int i = tape->made - 1; i >= 0; i--) step_adjoint(d, &tape->states[i], y_, all);
}
