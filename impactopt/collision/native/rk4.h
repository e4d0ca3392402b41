/* Steps of the classical Runge-Kutta method; see collision/graph.py. */

typedef struct {
  vec torque[V], deviation[V], torque2[V];
  double penetration, impulse, impulse2, target[NZ1];
#if SLIDES
  double sliding[3], sliding2[3], bristles[AT_LEAST_1(3 * BRISTLES)];
#endif
} Slope;

INLINE void slope_at(const Data *d, const State *y, const Instant *now, Slope *s) {
  s->penetration = now->rate;
  s->impulse = call(contact_force, &y->penetration, &now->rate, d->law);
  const double *in[] = {y->target, &s->impulse, d->target};
  double *out[] = {s->target};
  target_rates(in, out, 0, 0, 0);
  FOR(i, V) {
    s->torque[i] = now->net[i];
    if (STIFFNESS) s->deviation[i] = -now->u[i];
    if (SECOND_INTEGRALS) s->torque2[i] = y->torque[i];
  }
  s->impulse2 = y->impulse;
#if SLIDES
  friction_at(d, y, s->impulse, s->sliding, s->bristles);
  memcpy(s->sliding2, y->sliding, sizeof s->sliding2);
#endif
}

/* y := x + h s */
INLINE void add_slope(const State *x, const Slope *s, double h, State *y) {
  FOR(i, V) {
    y->torque[i] = x->torque[i] + h * s->torque[i];
    if (STIFFNESS) y->deviation[i] = x->deviation[i] + h * s->deviation[i];
    if (SECOND_INTEGRALS) y->torque2[i] = x->torque2[i] + h * s->torque2[i];
  }
  y->time = x->time + h;
  y->penetration = x->penetration + h * s->penetration;
  y->impulse = x->impulse + h * s->impulse;
  y->impulse2 = x->impulse2 + h * s->impulse2;
  FOR(i, NZ) y->target[i] = x->target[i] + h * s->target[i];
#if SLIDES
  FOR(k, 3) {
    y->sliding[k] = x->sliding[k] + h * s->sliding[k];
    y->sliding2[k] = x->sliding2[k] + h * s->sliding2[k];
  }
  FOR(k, 3 * BRISTLES) y->bristles[k] = x->bristles[k] + h * s->bristles[k];
#endif
}

#define MEAN(part) ((k1.part + 2.0 * k2.part + 2.0 * k3.part + k4.part) / 6.0)

INLINE void advance(const Data *d, State *y, const Instant *now, double h) {
  Slope k1, k2, k3, k4;
  State x;
  Instant then;
  slope_at(d, y, now, &k1);
  add_slope(y, &k1, h / 2, &x), evaluate_instant(d, &x, &then), slope_at(d, &x, &then, &k2);
  add_slope(y, &k2, h / 2, &x), evaluate_instant(d, &x, &then), slope_at(d, &x, &then, &k3);
  add_slope(y, &k3, h, &x), evaluate_instant(d, &x, &then), slope_at(d, &x, &then, &k4);
  FOR(i, V) {
    k1.torque[i] = MEAN(torque[i]);
    if (STIFFNESS) k1.deviation[i] = MEAN(deviation[i]);
    if (SECOND_INTEGRALS) k1.torque2[i] = MEAN(torque2[i]);
  }
#if PEAK
  y->peak = y->peak < k1.impulse ? k1.impulse : y->peak;
#endif
#if STEP_ERROR
  y->error_estimate += LEFT_OUT_BY_RK4 * fabs(k2.impulse - k3.impulse) * h;
#if SLIDES
  FOR(i, 3) y->error_estimate += LEFT_OUT_BY_RK4 * fabs(k2.sliding[i] - k3.sliding[i]) * h;
#endif
#endif
  k1.penetration = MEAN(penetration);
  k1.impulse = MEAN(impulse);
  k1.impulse2 = MEAN(impulse2);
  FOR(i, NZ) k1.target[i] = MEAN(target[i]);
#if SLIDES
  FOR(i, 3) k1.sliding[i] = MEAN(sliding[i]), k1.sliding2[i] = MEAN(sliding2[i]);
  FOR(i, 3 * BRISTLES) k1.bristles[i] = MEAN(bristles[i]);
#endif
  add_slope(y, &k1, h, y);
}

/* States at the begin of all steps, for the adjoint. */
typedef struct {
  int made;
  State states[GRADIENT ? STEPS_AT_ALL + 1 : 1];
} Tape;

/* Integrates y to separation, or to the end of the segment; returns the phase there. */
static Instant run(const Data *d, State *y, int steps, const Record *record, Tape *tape) {
  Instant now;
  int made = 0;
  for (;; made++) {
    evaluate_instant(d, y, &now);
    update_phase(d, y, &now);
    if (record && made % EVERY == 0 && made < steps) write_column(d, y, &now, record, made / EVERY);
    if (made == steps || !now.contact || !(y->time < d->until)) break;
    if (GRADIENT) tape->states[made] = *y;
    advance(d, y, &now, fmin(LENGTH, d->until - y->time));
  }
  if (GRADIENT) tape->states[made] = *y, tape->made = made;
  spread_nan(d, y, &now);
  if (record) {
    const int column = made < steps ? (made + EVERY - 1) / EVERY : record->columns - 1;
    write_column(d, y, &now, record, column);
    repeat_column(record, column);
  }
  return now;
}
