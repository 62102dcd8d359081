/* Peripherals of the AN385 that this port uses (Arm DAI 0385, CMSDK APB components). */

#ifndef CHIP_H
#define CHIP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum uart { UART_HOST, UART_WITNESS, UART_BENCH, UARTS };

/* Initialises clocks, UARTs, timer and watchdog; returns whether the watchdog reset the chip. */
bool chip_start(void);
/* Returns µs since power-up; must be called at least once per hour to detect wraps. */
uint64_t chip_now_us(void);
/* Sleeps until a byte arrives or until a time, a few milliseconds at most. host: whether bytes of the host wait, too. */
void chip_sleep(uint64_t until_us, bool host);
void chip_feed_watchdog(void);
/* Reads up to size received bytes. */
size_t chip_read(enum uart uart, uint8_t *bytes, size_t size);
void chip_write(enum uart uart, const uint8_t *bytes, size_t n);
/* Waits until the last written byte has left. */
void chip_flush(enum uart uart);

#endif
