/* The mirrors' measured positions: the ADC reads each axis every 10 µs, and the DMA keeps the last four readings. */

#ifndef FEEDBACK_H
#define FEEDBACK_H

#include <stdint.h>

/* Starts the ADC on PIN_FEEDBACK_X and PIN_FEEDBACK_Y; the chip's temperature is not measured from then on. */
void feedback_start(void);
/* Returns the positions in codes, of which one disturbed reading changes none; a disconnected input is beyond 65535. */
void feedback_read(int32_t *x, int32_t *y);

#endif
