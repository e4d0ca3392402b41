/* Tangents of the implicit steps, one step after the other: the same stages with what J changes by on their right-hand
   side. Lengths and phases are constants; where an event ends the step, the part of it that was gone is a root of the
   series, and moves with it. A name that begins with d is the tangent of what has the rest for its name. */

/* of Series, without what only the state needs */
typedef struct {
  vec speeds[TERMS][ROWS_OF_V][VD], demand[TERMS][N1][VD];
  vec impulse[TERMS][VD], penetration[TERMS][VD], rate[TERMS][VD], force[TERMS][VD], target[TERMS][NZ1][VD];
} SeriesTangent;

/* of the right-hand side of a stage, and what it gives */
typedef struct {
  vec torque[N1][VD], deviation[N1][VD], impulse[VD], penetration[VD], target[NZ1][VD];
} RightTangent;

typedef struct {
  vec speeds[ROWS_OF_V][VD], impulse[VD], penetration[VD], rate[VD], force[VD], target[NZ1][VD];
} LeftTangent;

/* of a step: what it is made of */
typedef struct {
  const Data *d;
  const FrozenTangent *frozen;
  const Series *series;
  const Resolvent *resolvent;
  const Bend *bend;
  const State *begin;
  vec dQ[STAGES][N + 1][VD];   /* times (T, -p) of each term but the first */
  /* of the joints: 1 but for saturated ones; friction's slope */
  double free[ROWS_OF_V] __attribute__((aligned(64))), slide[ROWS_OF_V] __attribute__((aligned(64)));
} Linear;

/* dQ times the terms' (T, -p), which are columns of x */
static void times_Q(const FrozenTangent *t, const double (*x)[STAGES], vec (*out)[N + 1][VD]) {
  FOR(i, N + 1) FOR_EACH(k) {
    vec s[STAGES];
    FOR(a, STAGES) s[a] = (vec){0};
    FOR(j, N + 1) {
      const vec of = t->Q[j][i][k];
      FOR(a, STAGES) s[a] += x[j][a] * of;
    }
    FOR(a, STAGES) out[a][i][k] = s[a];
  }
}

/* what comes with a state, in the piece of law and target that it is in */
static void rates_forward(const FrozenTangent *t, int kind, const Contact *c, StateTangent *x) {
  FOR_EACH(k) {
    x->target_speed[k] = (vec){0};
    FOR(i, NZ) x->target_speed[k] += c->at[i] * x->target[i][k];
    x->rate[k] = x->speeds[N][k] + t->hand_speed[kind][k] - x->target_speed[k];
    x->force[k] = c->k * x->penetration[k] + c->d * x->rate[k];
  }
}

/* out += factor times gains (one number a joint, or a matrix) times x */
INLINE void add_gain(const vec *gain, int matrix, double factor, const vec (*x)[VD], vec (*out)[VD]) {
  const double *g = (const double *)gain;
  FOR(i, N) {
    if (!matrix) FOR_EACH(k) out[i][k] += factor * g[i] * x[i][k];
    else FOR(j, N) FOR_EACH(k) out[i][k] += factor * g[j * V * LANES + i] * x[j][k];
  }
}
/* out += factor times the springs of what is not saturated times x */
INLINE void add_springs(const Linear *l, double factor, const vec (*x)[VD], vec (*out)[VD]) {
#if STIFFNESS && GAIN_MATRIX
  vec whole[N1][VD];
  memset(whole, 0, sizeof whole);
  add_gain((const vec *)l->d->kp, KP_MATRIX, factor, x, whole);
  FOR(i, N) FOR_EACH(k) out[i][k] += l->free[i] * whole[i][k];
#elif STIFFNESS
  add_gain(l->resolvent->kp, 0, factor, x, out);
#endif
}

/* tangents of n, term by term */
typedef vec InputsTangent[BENDS ? TERMS : 1][INPUTS][VD];

/* S b, with dJ's part on the right-hand side: dQ of both terms that this stage is made of, the drift's over `time` */
INLINE void solve_forward(const Linear *l, int kind, int stage, double time, const RightTangent *b,
                          const InputsTangent n, LeftTangent *x) {
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double *X = (const double *)r->X[N];
  vec rho[N1][VD], inputs[INPUTS][VD];
#if BENDS
  FOR(a, INPUTS) FOR_EACH(k)
    inputs[a][k] = either(stage, n[stage][a][k] + GAMMA_OF_STEPS * n[stage + 1][a][k], n[1][a][k]);
#else
  memset(inputs, 0, sizeof inputs);
#endif
  FOR(i, ROWS_OF_V) FOR_EACH(k) {
    vec a = {0};
    if (kind == BY_Q && i <= N) {
      a = l->dQ[stage ? stage - 1 : 0][i][k];
      if (stage) a += GAMMA_OF_STEPS * l->dQ[stage][i][k];
    }
#if BIAS || JDOT
    if (time != 0.0 && i <= N) a += l->frozen->drift[kind][i][k] * time;
#endif
    x->speeds[i][k] = a;
    if (i < N) rho[i][k] = b->torque[i][k];
  }
  add_gain((const vec *)r->D, GAIN_MATRIX, -r->g, (const vec(*)[VD])x->speeds, rho);
  add_springs(l, r->g, (const vec(*)[VD])b->deviation, rho);
  add_product(r->X, N, rho[0], VD, x->speeds[0]);
  const double slope = c->k * r->g + c->d;
  FOR_EACH(k) {
    vec rate = x->speeds[N][k] - X[N] * b->impulse[k], held[NZ1];
    FOR(i, NZ) {
      held[i] = (vec){0};
      FOR(j, NZ) held[i] += c->inverse[i][j] * b->target[j][k];
      if (TARGET_BENDS) FOR(j, NZ) held[i] += c->inverse[i][j] * r->g * inputs[1 + j][k];
      rate -= c->at[i] * held[i];
    }
    if (TARGET_BENDS) rate -= inputs[INPUTS - 1][k];
    x->force[k] = (c->k * b->penetration[k] + slope * rate + inputs[0][k]) / (1.0 + slope * r->g * c->mobility);
    x->impulse[k] = b->impulse[k] + r->g * x->force[k];
    x->rate[k] = rate - r->g * c->mobility * x->force[k];
    x->penetration[k] = b->penetration[k] + r->g * x->rate[k];
    FOR(i, NZ) x->target[i][k] = held[i] + r->g * c->moved[i] * x->force[k];
  }
  FOR(i, N + 1) FOR_EACH(k) x->speeds[i][k] -= X[i] * x->impulse[k];
}

/* the tangents of all terms, from that of the state at the begin */
static void terms_forward(const Linear *l, int kind, const StateTangent *dy, const InputsTangent n, SeriesTangent *s) {
  const Data *d = l->d;
  const Resolvent *r = l->resolvent;
  const Contact *c = &r->contact;
  const double h = r->h, by_gamma = 1.0 / GAMMA_OF_STEPS;
  RightTangent b;
  LeftTangent x;
  memcpy(s->speeds[0], dy->speeds, sizeof dy->speeds);
  memcpy(s->demand[0], dy->demand, sizeof dy->demand);
  FOR(i, N) FOR_EACH(k) {
    b.torque[i][k] = h * (l->free[i] * dy->demand[i][k] - l->slide[i] * dy->speeds[i][k]);
    b.deviation[i][k] = -h * dy->speeds[i][k];
  }
  if (FRICTION && kind == BY_V) FOR(i, N) *lane(b.torque[i], NV - N + i) -= h * l->slide[i];
  FOR_EACH(k) {
    s->impulse[0][k] = dy->impulse[k];
    s->penetration[0][k] = dy->penetration[k];
    s->rate[0][k] = dy->rate[k];
    s->force[0][k] = dy->force[k];
    b.impulse[k] = h * dy->force[k];
    b.penetration[k] = h * dy->rate[k];
    FOR(i, NZ) {
      s->target[0][i][k] = dy->target[i][k];
      vec rate = c->G[i] * dy->force[k];
      FOR(j, NZ) rate += c->Z[i][j] * dy->target[j][k];
      b.target[i][k] = h * rate;
    }
  }
  FOR(j, STAGES) {
    solve_forward(l, kind, j, j < 2 ? h : 0.0, &b, n, &x);
    vec net[N1][VD];
    memset(net, 0, sizeof net);
    add_gain((const vec *)r->D, GAIN_MATRIX, -1.0, (const vec(*)[VD])x.speeds, net);
    add_springs(l, 1.0, (const vec(*)[VD])b.deviation, net);
    memset(s->demand[j + 1], 0, sizeof s->demand[j + 1]);
    FOR_EACH(k) s->speeds[j + 1][N][k] = either(j, (x.speeds[N][k] - s->speeds[j][N][k]) * by_gamma, x.speeds[N][k]);
    FOR(i, N) FOR_EACH(k) {
      vec v = x.speeds[i][k];
      if (j) {
        b.torque[i][k] = h * net[i][k];
        b.deviation[i][k] = -h * v;
        v = (v - s->speeds[j][i][k]) * by_gamma;
      } else {
        b.torque[i][k] += r->g * net[i][k];
        b.deviation[i][k] -= r->g * v;
      }
      s->speeds[j + 1][i][k] = v;
    }
    add_gain((const vec *)d->kd, KD_MATRIX, -1.0, (const vec(*)[VD])s->speeds[j + 1], s->demand[j + 1]);
#if STIFFNESS
    add_gain((const vec *)d->kp, KP_MATRIX, 1.0, (const vec(*)[VD])b.deviation, s->demand[j + 1]);
#endif
    FOR_EACH(k) {
      b.impulse[k] = s->impulse[j + 1][k] = either(j, h * x.force[k], x.impulse[k]);
      b.penetration[k] = s->penetration[j + 1][k] = either(j, h * x.rate[k], x.penetration[k]);
      FOR(i, NZ) {
        const vec z = either(j, (x.target[i][k] - s->target[j][i][k]) * by_gamma, x.target[i][k]);
        b.target[i][k] = s->target[j + 1][i][k] = z;
      }
      s->rate[j + 1][k] = either(j, (x.rate[k] - s->rate[j][k]) * by_gamma, x.rate[k]);
      s->force[j + 1][k] = either(j, (x.force[k] - s->force[j][k]) * by_gamma, x.force[k]);
    }
  }
}

#if BENDS
/* of n, from tangents of the series at n as it is */
static void bend_forward(const Bend *b, const SeriesTangent *s, InputsTangent n) {
  double at[NV][UNKNOWNS];
  FOR(i, NODES) {
    vec seen[SEEN][VD];
    FOR_EACH(k) FOR(o, SEEN) {
      seen[o][k] = (vec){0};
      FOR(j, TERMS) {
        const vec w = o == 0 ? s->penetration[j][k] : o == 1 ? s->rate[j][k] : s->target[j][(o - 2) % NZ1][k];
        seen[o][k] += AT_NODES[i][j] * w;
      }
    }
    FOR(seed, NV) FOR(a, INPUTS) {
      double x = 0.0;
      FOR(o, SEEN) x += b->by[i][a][o] * ((const double *)seen[o])[seed];
      at[seed][a * NODES + i] = x;
    }
  }
  memset(n, 0, sizeof(InputsTangent));
  FOR(seed, NV) {
    solve_bend(b, at[seed]);
    FOR(j, TERMS) FOR(a, INPUTS) FOR(i, NODES)
      *lane(n[j][a], seed) += FROM_NODES[j][i] * at[seed][a * NODES + i];
  }
}
#endif

static void series_forward(const Linear *l, int kind, const StateTangent *dy, SeriesTangent *s) {
  InputsTangent n;
  memset(n, 0, sizeof n);
  terms_forward(l, kind, dy, (const vec(*)[INPUTS][VD])n, s);
#if BENDS
  bend_forward(l->bend, s, n);
  terms_forward(l, kind, dy, (const vec(*)[INPUTS][VD])n, s);
#endif
}

/* ------------------------------------------------------------ places within a step */
/* law and target in their piece, at an instant within a step */
static void contact_within(const Linear *l, const State *then, const Instant *now, const Instant *at, Contact *c) {
  *c = l->resolvent->contact;
#if LAW_BENDS
  double law[3];
  law_here(l->d, then->penetration, at->rate, now->compressing, law);
  c->k = law[1], c->d = law[2];
#endif
#if TARGET_BENDS
  double Z[NZ * NZ], G[NZ1];
  const double force = 0.0, *in[] = {then->target, &force, l->d->target};
  double *out[] = {Z, G, c->at};
  target_slopes(in, out, 0, 0, 0);
#endif
}

INLINE vec along(const vec *w, long stride, const double *p) {
  vec s = w[0];
  for (int j = 1; j < TERMS; j++) s += p[j] * w[j * stride];
  return s;
}
#define ALONG(w, ...) along(&(w)[0] __VA_ARGS__, (&(w)[1] __VA_ARGS__) - (&(w)[0] __VA_ARGS__), p)

/* how the event's place moves */
static void event_forward(const Linear *l, int kind, const Event *e, const SeriesTangent *t, vec *moved) {
  const Series *s = l->series;
  const int i = e->number;
  double p[TERMS], slope[TERMS], along_step = 0.0, by_force = 0.0;
  powers(e->at, p);
  slopes(e->at, slope);
  FOR_EACH(k) moved[k] = (vec){0};
  if (e->kind == OF_RATE) {
    along_step = change(s->rate, slope);
    FOR_EACH(k) moved[k] = ALONG(t->rate, [k]);
  } else if (e->kind == OF_DEMAND) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->demand[j])[i];
    FOR_EACH(k) moved[k] = ALONG(t->demand, [i][k]);
  } else if (e->kind == OF_SLIDING) {
    for (int j = 1; j < TERMS; j++) along_step += slope[j] * ((const double *)s->speeds[j])[i];
    FOR_EACH(k) moved[k] = ALONG(t->speeds, [i][k]);
    if (kind == BY_V) *lane(moved, NV - N + i) += 1.0;
  } else if (e->kind == OF_FORCE) {
#if LAW_BENDS
    double at[3];
    separation_at(l->d, s, e->at, at);
    along_step = at[1] * change(s->penetration, slope) + at[2] * change(s->rate, slope);
    FOR_EACH(k) moved[k] = at[1] * ALONG(t->penetration, [k]) + at[2] * ALONG(t->rate, [k]);
#else
    by_force = 1.0;
#endif
  }
#if SWITCHES
  if (e->kind == OF_SWITCH) {
    Switch x;
    switch_in(l->d, s, e->at, &x);
    by_force = x.by_force[i];
    FOR(z, NZ) {
      const double by = x.by_z[i + SWITCHES * z];
      along_step += by * change(s->target[z], slope);
      FOR_EACH(k) moved[k] += by * ALONG(t->target, [z][k]);
    }
  }
#endif
  if (by_force != 0.0) {
    along_step += by_force * change(s->force, slope);
    FOR_EACH(k) moved[k] += by_force * ALONG(t->force, [k]);
  }
  FOR_EACH(k) moved[k] = either(along_step != 0.0, -moved[k] / along_step, (vec){0});
}

/* the state at a part of the step that moves by `moved`, with speeds from row `first` on; time and peak stay */
static void state_forward(const Linear *l, double part, const vec *moved, const SeriesTangent *t, int first,
                          StateTangent *x) {
  const Series *s = l->series;
  double p[TERMS], slope[TERMS];
  powers(part, p);
  slopes(part, slope);
  for (int i = first; i <= N; i++) {
    double by = 0.0;
    for (int j = 1; j < TERMS; j++) by += slope[j] * ((const double *)s->speeds[j])[i];
    FOR_EACH(k) x->speeds[i][k] = ALONG(t->speeds, [i][k]) + by * moved[k];
  }
  FOR_EACH(k) {
    x->penetration[k] = ALONG(t->penetration, [k]) + change(s->penetration, slope) * moved[k];
    x->impulse[k] = ALONG(t->impulse, [k]) + change(s->impulse, slope) * moved[k];
    FOR(i, NZ) x->target[i][k] = ALONG(t->target, [i][k]) + change(s->target[i], slope) * moved[k];
  }
  FOR(i, N) {
    double by = 0.0;
    for (int j = 1; j < TERMS; j++) by += slope[j] * ((const double *)s->demand[j])[i];
    FOR_EACH(k) x->demand[i][k] = ALONG(t->demand, [i][k]) + by * moved[k];
  }
}

#if PEAK
static void peak_forward(const Linear *l, double theta, const vec *moved, const SeriesTangent *t, StateTangent *dy) {
  double p[TERMS], slope[TERMS], place;
  if (!(l->begin->peak < largest(l->series->force, theta, l->begin->peak, &place))) return;
  powers(place, p);
  slopes(place, slope);
  const double at_end = place == theta ? change(l->series->force, slope) : 0.0;
  FOR_EACH(k) dy->peak[k] = ALONG(t->force, [k]) + at_end * moved[k];
}
#endif
