/* Buffers of packets that program and USB controller hand to each other, and the numbers of the packets. */

#ifndef USB_BUFFERS_H
#define USB_BUFFERS_H

#include <stdbool.h>
#include <stdint.h>

enum way { IN, OUT }; /* as the computer sees it */

/* Gives a buffer to the controller: to send its first bytes, or to receive up to that number. */
void buffer_arm(uint32_t endpoint, enum way way, uint32_t length);
/* Takes a buffer back, done or not. */
void buffer_take_back(uint32_t endpoint, enum way way);
/* Returns whether the controller has sent or filled a buffer since it was given. */
bool buffer_pop_done(uint32_t endpoint, enum way way);
/* Number of bytes to send, or received. */
uint32_t buffer_length(uint32_t endpoint, enum way way);
/* The next packet is DATA0 or DATA1, and they alternate from there. */
void buffer_count_from(uint32_t endpoint, enum way way, uint32_t number);

#endif
