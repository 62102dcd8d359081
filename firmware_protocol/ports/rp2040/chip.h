/* What the port needs of the chip: clocks, time, the alarm, bytes, watchdog, noise. */

#ifndef CHIP_H
#define CHIP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"

#define CLOCK_HZ 125000000u

/* Clocks, pins' peripherals and the UART; the outputs are not touched. */
void chip_start(void);
/* Why the program began. */
enum reset_cause chip_reset_cause(void);

/* µs since power-up, 64 bits. */
uint64_t chip_now_us(void);
void chip_wait_us(uint32_t us);

/* Calls on_alarm from an interrupt at that time, at once where it is past. One is waited for, the last one set. */
void chip_set_alarm(uint64_t at_us);
void on_alarm(void);
/* Between these two no alarm comes; one that was due meanwhile comes after. */
void chip_hold_alarm(void);
void chip_release_alarm(void);

/* Bytes that received; at most size of them. */
size_t chip_read(uint8_t *bytes, size_t size);
/* Whether a BREAK received since it was asked last. */
bool chip_pop_break(void);
/* A whole frame or nothing; never waits. From the alarm, or with the alarm held. */
void chip_send(const uint8_t *frame, size_t n);
/* Drops what waits; a frame that has begun to leave goes to its end. */
void chip_discard_output(void);

/* A reset follows when it is not fed for 40 ms. */
void chip_start_watchdog(void);
void chip_feed_watchdog(void);

/* Takes a bit of noise into the entropy_pool: often, from the main loop. */
void chip_collect_entropy(void);
uint32_t chip_entropy(void);
int16_t chip_temperature_dc(void);

#endif
