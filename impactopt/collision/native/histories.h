/* Histories: one column per instant, written straight into the outputs; see collision/outputs.py. */

static void fill_with_nan(double **res) {
  FOR(k, N_OUT) if (res[k]) FOR(i, SHAPES_OUT[k][0] * SHAPES_OUT[k][1]) res[k][i] = __builtin_nan("");
}

typedef struct {
  double **out;
  const double *v; /* at contact */
  double since;
  int column, columns; /* of this segment: its first column, and their number */
} Record;

/* outputs without their derivatives */
#define N_VALUES ((int)(sizeof ROWS / sizeof *ROWS))
#define COLUMN_OF(name, rows) (out[OUT_##name] + (long)(rows) * column)

/* Wrench of the ground on the robot about the world's origin, from the wrenches at the soles. */
static void ground_wrench_of(const Frozen *F, const double *w, double *total) {
  memcpy(total, F->unmodelled, sizeof F->unmodelled);
  FOR(s, SOLES) {
    const double *f = w + 6 * s, *p = F->soles + 3 * s;
    FOR(i, 6) total[i] += f[i];
    total[3] += p[1] * f[2] - p[2] * f[1];
    total[4] += p[2] * f[0] - p[0] * f[2];
    total[5] += p[0] * f[1] - p[1] * f[0];
  }
}

static void write_column(const Data *d, const State *y, const Instant *now, const Record *record, int column) {
  double **out = record->out;
  column += record->column;
#ifdef OUT_time
  if (out[OUT_time]) *COLUMN_OF(time, 1) = record->since + y->time;
#endif
#ifdef OUT_penetration
  if (out[OUT_penetration]) *COLUMN_OF(penetration, 1) = y->penetration;
#endif
#ifdef OUT_hand_speed
  if (out[OUT_hand_speed]) *COLUMN_OF(hand_speed, 1) = now->speed;
#endif
#ifdef OUT_target_speed
  if (out[OUT_target_speed]) *COLUMN_OF(target_speed, 1) = now->target_speed;
#endif
#ifdef OUT_joint_velocity
  if (out[OUT_joint_velocity]) FOR(i, N) {
    double *to = COLUMN_OF(joint_velocity, N) + i;
    *to = record->v[NV - N + i] + ((const double *)now->u)[i];
#if REFERENCE
    *to += ((const double *)d->reference_change)[i] + ((const double *)d->reference_acceleration)[i] * y->time;
#endif
  }
#endif
#ifdef OUT_torque
  if (out[OUT_torque]) memcpy(COLUMN_OF(torque, N), now->torque, N * sizeof(double));
#endif
#ifdef OUT_demand
  if (out[OUT_demand]) memcpy(COLUMN_OF(demand, N), now->demand, N * sizeof(double));
#endif
#if defined(OUT_force) || HELD_HISTORY
  const double force = call(contact_force, &y->penetration, &now->rate, d->law);
#endif
#ifdef OUT_force
  if (out[OUT_force]) *COLUMN_OF(force, 1) = force;
#endif
#if HELD_HISTORY
  vec held[VC];
  double friction[3], rate[3];
  friction_at(d, y, force, friction, rate);
  wrench_of(d->frozen, (const double *)now->net, force, friction, 1.0, held);
  const double *w = (const double *)held;
#ifdef OUT_sole_wrench
  if (out[OUT_sole_wrench]) memcpy(COLUMN_OF(sole_wrench, 6 * SOLES), w, 6 * SOLES * sizeof(double));
#endif
#ifdef OUT_hand_wrench
  if (out[OUT_hand_wrench])
    memcpy(COLUMN_OF(hand_wrench, C - 6 * SOLES), w + 6 * SOLES, (C - 6 * SOLES) * sizeof(double));
#endif
#if defined(OUT_ground_wrench) || defined(OUT_zmp)
  double total[6];
  ground_wrench_of(d->frozen, w, total);
#endif
#ifdef OUT_ground_wrench
  if (out[OUT_ground_wrench]) memcpy(COLUMN_OF(ground_wrench, 6), total, sizeof total);
#endif
#ifdef OUT_zmp
  if (out[OUT_zmp]) {
    COLUMN_OF(zmp, 2)[0] = -total[4] / total[2];
    COLUMN_OF(zmp, 2)[1] = total[3] / total[2];
  }
#endif
#endif
}

/* Fills the columns after `column` with its values. */
static void repeat_column(const Record *record, int column) {
  const int begin = record->column + column, end = record->column + record->columns;
  FOR(i, N_VALUES) {
    const int rows = ROWS[i];
    if (!rows || !record->out[i]) continue;
    const double *from = record->out[i] + (long)rows * begin;
    for (int k = begin + 1; k < end; k++) memcpy(record->out[i] + (long)rows * k, from, rows * sizeof(double));
  }
}
