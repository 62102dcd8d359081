/* A digital scan head by XY2-100: the PIO sends a frame each 10 µs and reads the status that returns with it. */

#ifndef XY2_100_H
#define XY2_100_H

#include <stdbool.h>
#include <stdint.h>

/* Starts the frames, at the centre. The pins are outputs of the PIO from here on. */
void xy2_100_start(void);
/* Both positions are in the same frame, which begins at most 10 µs later; they repeat until the next call. */
void xy2_100_move(uint16_t x, uint16_t y);
/* Returns whether a valid status came since the last call within the last two frames, and its word; of two, the bits that
   both have. */
bool xy2_100_read_status(uint16_t *word);

#endif
