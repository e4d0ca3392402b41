/* The loop over steps of one length backwards; see steps.h. */

/* from the final state back to what is frozen */
static void run_back(const Data *d, const Tape *tape, int in_contact, State *y_, Back *all) {
  if (tape->made % BLOCK && in_contact) step_back(d, &tape->states[tape->made], 0, y_, all);
  for (int i = tape->made - 1; i >= 0; i--) step_back(d, &tape->states[i], 1, y_, all);
}
