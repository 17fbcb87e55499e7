/* What measure.c needs of a machine. */
#ifndef MEASURE_H
#define MEASURE_H

#include <stdint.h>

void measure_start(void);
uint32_t measure_count(void); /* instructions so far, times MEASURE_SCALE; wraps */
void measure_print(const char *text);

#endif
