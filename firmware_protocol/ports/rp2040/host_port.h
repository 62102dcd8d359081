/* The port of the host: the one of UART and USB that a program opened first. It holds the board until it closes. */

#ifndef HOST_PORT_H
#define HOST_PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* uid: 12 bytes, by which a computer tells two boards on USB apart. */
void host_start(const uint8_t *uid);
/* Serves the ports, from the main loop; returns whether the link is lost: the port that held the board has closed, or received
   a BREAK. */
bool host_serve(void);
/* Reads up to size bytes from the port that holds the board, none beyond the end of a frame: the tick waits while the core
   answers one. */
size_t host_read(uint8_t *bytes, size_t size);
/* Queues a whole frame or nothing, without blocking; called from the alarm or with the alarm held. */
void host_send(const uint8_t *frame, size_t n);
/* Discards queued frames; a partly sent frame is completed. Called like host_send. */
void host_discard_output(void);

#endif
