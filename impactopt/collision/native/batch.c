/* Many collisions without the interpreter between them. Slices of a batch may run in threads, each with its own work
   memory. Inputs and outputs of successive collisions are arg_step and res_step numbers apart; 0 repeats an input. */

EXPORT void OF_NAME(batch)(Int begin, Int end, const double *const *arg, const Int *arg_step, double *const *res,
                           const Int *res_step, double *w) {
  const double *in[N_IN];
  double *out[N_OUT];
  for (Int i = begin; i < end; i++) {
    FOR(k, N_IN) in[k] = arg[k] + i * arg_step[k];
    FOR(k, N_OUT) out[k] = res[k] + i * res_step[k];
    NAME(in, out, 0, w, 0);
  }
}
