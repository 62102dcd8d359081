/* UART 0 to an adapter, whose DTR# shows whether a program has its port open. */

#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void uart_start(void);
bool uart_is_open(void);
/* Whether it sends what is outgoing. */
void uart_select(bool selected);
/* Returns whether a BREAK was received since the last call. */
bool uart_pop_break(void);
/* Reads up to size received bytes, none beyond the end of a frame. */
size_t uart_read(uint8_t *bytes, size_t size);
/* Discards the received bytes. */
void uart_skip(void);
/* Queues a whole frame or nothing, and begins to send; called from the alarm or with the alarm held. */
void uart_send(const uint8_t *frame, size_t n);
/* Discards queued frames; a partly sent one is completed. */
void uart_discard(void);

#endif
