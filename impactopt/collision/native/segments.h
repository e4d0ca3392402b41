/* One collision: the model frozen at contact, and frozen again in each segment; see collision/model.py. */

typedef struct {
  Frozen frozen;
  Data data;
#if FREEZES
  Frozen frozen_at_contact;
  Data data_at_contact;
#endif
  Tape tape;
  double q[NQ], v[NV], normal[3];
} Work;

static void copy_or_zero(const double *from, double *to, int n) {
  FOR(i, n) to[i] = from ? from[i] : 0.0;
}

static void load_data(const double **arg, Data *d) {
  double ones[V * LANES];
  FOR(i, V * LANES) ones[i] = 1.0;
  pad(d->joint_mask, V, ones, N, 0.0);
#if N
#if KD_MATRIX
  FOR(j, N) pad(d->kd[j], V, arg[ARG_kd] ? arg[ARG_kd] + N * j : 0, N, 0.0);
#else
  pad(d->kd, V, arg[ARG_kd], N, 0.0);
#endif
#if STIFFNESS && KP_MATRIX
  FOR(j, N) pad(d->kp[j], V, arg[ARG_kp] ? arg[ARG_kp] + N * j : 0, N, 0.0);
#elif STIFFNESS
  pad(d->kp, V, arg[ARG_kp], N, 0.0);
#endif
#else
  memset(d->kd, 0, sizeof d->kd);
#endif
#if SATURATION
  pad(d->limit, V, arg[ARG_torque_limit], N, 1.0);
#endif
#if FRICTION
  pad(d->viscous, V, arg[ARG_viscous], N, 0.0);
  pad(d->coulomb, V, arg[ARG_coulomb], N, 0.0);
  pad(d->joint_velocity, V, arg[ARG_v] ? arg[ARG_v] + NV - N : 0, N, 0.0);
#endif
#if FEEDFORWARD
  pad(d->feedforward, V, arg[ARG_feedforward], N, 0.0);
#endif
#if SLIDES
  copy_or_zero(arg[ARG_friction_coefficient], &d->coefficient, 1);
  copy_or_zero(arg[ARG_friction_slip_speed], &d->slip_speed, 1);
#if BRISTLES
  copy_or_zero(arg[ARG_friction_stiffness], &d->stiffness, 1);
#endif
  copy_or_zero(arg[ARG_normal], d->normal, 3);
#endif
  FOR(i, N_LAW) copy_or_zero(arg[ARG_law + i], d->law + i, 1);
  FOR(i, N_TARGET) copy_or_zero(arg[ARG_target + i], d->target + i, 1);
#if MOVES_TARGET
  d->mobility = call(tangential_mobility, d->target, 0, 0);
#endif
}

/* Freezes the servo's reference, a polynomial in time: its acceleration at `time` since contact, and the change of its
   velocity from contact to `begin`. Velocities are relative to the reference from here on; see collision/model.py. */
static void freeze_reference(const double **arg, double time, double begin, Work *w) {
#if REFERENCE
  const double *given = arg[ARG_reference], until = arg[ARG_reference_until] ? *arg[ARG_reference_until] : 0.0;
  double reference_acceleration[N1], reference_change[N1];
  const int ends_later = time < until;
  begin = fmin(begin, until);
  FOR(j, N) {
    reference_acceleration[j] = reference_change[j] = 0.0;
    for (int k = REFERENCE - 1; k >= 0; k--) {
      const double x = given ? given[N * k + j] : 0.0;
      reference_acceleration[j] = reference_acceleration[j] * time + (ends_later ? (k + 1) * x : 0.0);
      reference_change[j] = (reference_change[j] + x) * begin;
    }
  }
  pad(w->data.reference_acceleration, V, reference_acceleration, N, 0.0);
  pad(w->data.reference_change, V, reference_change, N, 0.0);
  FOR(i, V) w->frozen.drift[i] -= w->data.reference_acceleration[i];
#endif
}

static const double *or_zeros(const double *given, double *zeros, int n) {
  if (given) return given;
  copy_or_zero(0, zeros, n);
  return zeros;
}

#if FREEZES
/* Configuration and velocity at state y, from those at the begin of the segment. */
static void advance_posture(const Frozen *F, const double *q, const double *v, const State *y, double *q_then,
                            double *v_then) {
  double displacement[NV], change[NV], from[NQ];
  memcpy(from, q, sizeof from);
  velocity_change(F, y->torque2, y->impulse2, SLIDING2(y), y->time * y->time / 2, displacement);
  velocity_change(F, y->torque, y->impulse, SLIDING(y), y->time, change);
  FOR(i, NV) displacement[i] = v[i] * y->time + displacement[i];
  const double *in[] = {from, displacement};
  double *out[] = {q_then};
  integrate(in, out, 0, 0, 0);
  FOR(i, NV) v_then[i] = v[i] + change[i];
}
#endif

/* Result of a collision. */
typedef struct {
  State final;
  double impulse, duration, in_contact;
  double q[NQ], v[NV]; /* at the begin of the last segment */
#if MOVES_TARGET
  double tangential[3]; /* velocity of the target across the normal */
#endif
} Outcome;

#if FREEZES
/* Fills a segment that begins after separation with the last column of the one before. */
static void repeat_last_column(const Record *record) {
  const Record longer = {.out = record->out, .column = record->column - 1, .columns = record->columns + 1};
  repeat_column(&longer, 0);
}

/* Integrates n segments from contact on, which together take about `duration`; w holds the model frozen at contact.
   A segment is integrated twice: to its middle with the last frozen model, where the model is frozen anew, and then
   whole with that one. */
static void run_segments(const double **arg, Work *w, Outcome *c, double duration, int n, Record *recorded) {
  Frozen *F = &w->frozen;
  Data *d = &w->data;
  const double *q = or_zeros(arg[ARG_q], w->q, NQ), *v = or_zeros(arg[ARG_v], w->v, NV);
  const double *normal = or_zeros(arg[ARG_normal], w->normal, 3);
  const int whole = n == FREEZES; /* else a trial with one segment, which finds the duration */
  State start = {0}, reached = {0}, middle;
  double q_middle[NQ], v_middle[NV], q_then[NQ], v_then[NV];
  memcpy(c->q, q, sizeof c->q);
  memcpy(c->v, v, sizeof c->v);
  FOR(i, V) d->velocity_before[i] = (vec){0};
  c->impulse = c->duration = 0.0;
  c->in_contact = 1.0;
#if MOVES_TARGET
  memset(c->tangential, 0, sizeof c->tangential);
#endif
  FOR(i, n) {
    const double begin = whole ? ENDS[i] : 0.0, end = whole ? ENDS[i + 1] : 1.0, share = end - begin;
    const int last = i == n - 1;
    middle = reached;
    d->until = reached.time + duration * share / 2;
    run(d, &middle, whole ? STEPS_TO_MIDDLE[i] : STEPS_AT_ALL, 0, &w->tape);
    advance_posture(F, c->q, c->v, &middle, q_middle, v_middle);
    if (i) {
      advance_posture(F, c->q, c->v, &reached, q_then, v_then);
      memcpy(c->q, q_then, sizeof c->q);
      memcpy(c->v, v_then, sizeof c->v);
    }
    freeze(q_middle, v_middle, normal, GIVES_WAY, 0.0, F);
    freeze_reference(arg, duration * (begin + end) / 2, duration * begin, w);
    const double *in[] = {c->q, c->v, normal};
    double *out[] = {
      &d->hand_speed,
#if SLIDES
      d->point_velocity,
#endif
    };
    hand_speed_at(in, out, 0, 0, 0);
#if MOVES_TARGET
    FOR(k, 3) d->point_velocity[k] -= c->tangential[k];
#endif
    double before[NV];
    FOR(k, NV) before[k] = c->v[k] - v[k];
    pad(d->velocity_before, V, before + NV - N, N, 0.0);
#if REFERENCE
    FOR(k, V) d->velocity_before[k] -= d->reference_change[k];
#endif
    d->until = c->in_contact ? (last ? HORIZON - duration * begin : duration * share) : -1.0;
    if (recorded) {
      recorded->since = duration * begin;
      recorded->columns = N_COLUMNS[i];
    }
    Record *record = c->in_contact ? recorded : 0;
    if (recorded && !record) repeat_last_column(recorded);
    reached = start;
    c->in_contact *= run(d, &reached, whole ? STEPS[i] : STEPS_AT_ALL, record, &w->tape).contact;
    if (recorded) recorded->column += N_COLUMNS[i];
    c->impulse += reached.impulse;
    c->duration += reached.time;
    c->final = reached;
#if MOVES_TARGET
    FOR(k, 3) c->tangential[k] += d->mobility * reached.sliding[k];
#endif
    start = reached;
    start.time = start.impulse = start.impulse2 = 0.0;
    memset(start.torque, 0, sizeof start.torque);
    memset(start.torque2, 0, sizeof start.torque2);
#if SLIDES
    memset(start.sliding, 0, sizeof start.sliding);
    memset(start.sliding2, 0, sizeof start.sliding2);
#endif
  }
}
#endif

static void collide(const double **arg, double **res, Work *w, Outcome *c) {
  Frozen *F = &w->frozen;
  Data *d = &w->data;
  const double *q = or_zeros(arg[ARG_q], w->q, NQ), *v = or_zeros(arg[ARG_v], w->v, NV);
  const double *normal = or_zeros(arg[ARG_normal], w->normal, 3);
  Record recorded = {.out = res, .v = v, .columns = N_COLUMNS[0]};
  Record *record = HISTORIES ? &recorded : 0;
  load_data(arg, d);
  freeze(q, v, normal, call(target_inverse_mass, d->target, 0, 0), call(target_speed_before, d->target, 0, 0), F);
  freeze_reference(arg, 0.0, 0.0, w);
  d->frozen = F;
  d->hand_speed = F->hand_speed;
#if SLIDES
  memcpy(d->point_velocity, F->point_velocity, sizeof d->point_velocity);
#endif
  memset(&c->final, 0, sizeof c->final);
  d->until = HORIZON;
#if !FREEZES
  memcpy(c->q, q, sizeof c->q);
  memcpy(c->v, v, sizeof c->v);
  c->in_contact = run(d, &c->final, STEPS[0], record, &w->tape).contact;
  c->impulse = c->final.impulse;
  c->duration = c->final.time;
#if MOVES_TARGET
  FOR(k, 3) c->tangential[k] = d->mobility * c->final.sliding[k];
#endif
#else
  State reached = {0};
  FOR(i, V) d->velocity_before[i] = (vec){0};
  run(d, &reached, STEPS_AT_ALL, 0, &w->tape);
  w->frozen_at_contact = *F;
  w->data_at_contact = *d;
  run_segments(arg, w, c, reached.time, 1, 0);
  *F = w->frozen_at_contact;
  *d = w->data_at_contact;
  run_segments(arg, w, c, c->duration, FREEZES, record);
#endif
}
