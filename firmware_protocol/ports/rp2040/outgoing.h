/* Frames on their way to the host that holds the board. The callers see to it that no two calls interrupt each other. */

#ifndef OUTGOING_H
#define OUTGOING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Adds a whole frame, or nothing if it does not fit. */
void outgoing_add(const uint8_t *frame, size_t n);
/* Takes the next byte; returns whether there was one. */
bool outgoing_take(uint8_t *byte);
/* Discards the frames that are not begun; a partly taken one is completed. */
void outgoing_discard(void);
/* Discards everything. */
void outgoing_clear(void);

#endif
