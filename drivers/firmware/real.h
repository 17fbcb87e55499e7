/* Floating-point type of the firmware: float, or double with -DREAL_DOUBLE. */
#ifndef REAL_H
#define REAL_H

#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "a lifted finger is NaN here: compile without -ffast-math, -Ofast and -ffinite-math-only"
#endif

#ifdef REAL_DOUBLE
typedef double real_t;
#define REAL(number) number
#define real_abs fabs
#define real_rint rint
#define real_sqrt sqrt
#else
typedef float real_t;
#define REAL(number) number##F
#define real_abs fabsf
#define real_rint rintf
#define real_sqrt sqrtf
#endif

static inline real_t real_min(real_t a, real_t b) { return (b < a) ? b : a; }
static inline real_t real_max(real_t a, real_t b) { return (b > a) ? b : a; }
static inline real_t real_clip(real_t x, real_t least, real_t most) { return real_min(real_max(x, least), most); }

#endif
