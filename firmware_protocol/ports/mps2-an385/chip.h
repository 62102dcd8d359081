/* Peripherals of the AN385 that this port uses (Arm DAI 0385, CMSDK APB components). */

#ifndef CHIP_H
#define CHIP_H

#include <stdbool.h>
#include <stdint.h>

/* Initialises clock and watchdog; returns whether the watchdog reset the chip. */
bool chip_start(void);
/* Returns µs since power-up, also after a reset; must be called at least once per hour to detect wraps. */
uint64_t chip_now_us(void);
/* Returns the time of the last reset, 0 since power-up. */
uint64_t chip_reset_us(void);
/* Waits until a time, at most a minute. */
void chip_wait_until(uint64_t at_us);
void chip_feed_watchdog(void);

#endif
