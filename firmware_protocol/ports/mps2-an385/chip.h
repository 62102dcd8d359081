/* What this port needs of the AN385's peripherals (Arm DAI 0385, CMSDK APB components). */

#ifndef CHIP_H
#define CHIP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum uart { UART_HOST, UART_WITNESS, UART_BENCH, UARTS };

/* Clocks, UARTs, the timer, the watchdog; true where it was the watchdog that reset the chip. */
bool chip_start(void);
/* µs since power-up; may be asked as often as one likes, but at least once an hour. */
uint64_t chip_now_us(void);
/* Waits in sleep for a byte or until a time, a few milliseconds at most. */
void chip_sleep(uint64_t until_us);
void chip_feed_watchdog(void);
/* Bytes that came; at most size of them. */
size_t chip_read(enum uart uart, uint8_t *bytes, size_t size);
void chip_write(enum uart uart, const uint8_t *bytes, size_t n);

#endif
