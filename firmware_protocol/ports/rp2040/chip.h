/* Functions of the chip: clocks, time, alarm, watchdog, entropy. */

#ifndef CHIP_H
#define CHIP_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

#define FIRMWARE 0x00010100u /* version of this port */
#define CLOCK_HZ 125000000u
#define CHIP_SLEEP_US 250u

/* Initialises clocks and peripherals, but neither the outputs nor the host's ports. on_alarm: called from the alarm's interrupt. */
void chip_start(void (*on_alarm)(void));
/* Returns the cause of the last reset. */
enum reset_cause chip_reset_cause(void);

/* µs since power-up, 64 bits. */
uint64_t chip_now_us(void);
void chip_wait_us(uint32_t us);

/* Interrupts at at_us, at once if that is past. A new alarm replaces the last one. */
void chip_set_alarm(uint64_t at_us);
/* No alarm interrupts between hold and release; one that is due in between follows the release. */
void chip_hold_alarm(void);
void chip_release_alarm(void);
/* Completes the accesses before it, so that an interrupt disabled there does not come any more. */
void chip_fence(void);

/* Starts the capture of rising edges at a pin; its interrupt precedes all others, so that the time is exact. */
void chip_start_trigger(uint32_t pin);
/* Returns the number of edges so far, and the time of the last one if any. At most one counts between two calls: an
   input that oscillates costs no more. */
uint32_t chip_read_triggers(uint64_t *last_us);

/* Sleeps until an interrupt, at most for CHIP_SLEEP_US even if the alarm has failed. */
void chip_sleep(void);

/* Starts the watchdog, which resets the chip after 40 ms without a feed. */
void chip_start_watchdog(void);
void chip_feed_watchdog(void);

/* Adds a bit of noise to the entropy pool; called often from the main loop. */
void chip_collect_entropy(void);
uint32_t chip_entropy(void);
int16_t chip_temperature_dc(void);

#endif
