#include "chip.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define WATCHDOG 0x40008000u
#define WATCHDOG_LOAD 0x0u
#define WATCHDOG_CTRL 0x8u
#define WATCHDOG_CLEAR 0xcu
#define FPGA_COUNTER 0x40028018u
#define FPGA_PRESCALE 0x4002801cu

#define CLOCK_HZ 25000000u
#define CYCLES_PER_US (CLOCK_HZ / 1000000u)
#define TURNS_PER_US 15u   /* at most those of 2 × 32 ns */
#define WATCHDOG_US 25000u /* to its interrupt, and again to the reset */
#define RAN_BEFORE 0x52414e21u

/* Not cleared at reset: marks that the program ran since power-up, so the reset came from the watchdog, and tells when
   that was. */
__attribute__((section(".noinit"))) static volatile uint32_t ran_before;
__attribute__((section(".noinit"))) static volatile uint64_t fed_us;

static uint64_t reset_us; /* the counter restarts */

void watchdog_isr(void) {} /* the ticks, and with them the guards, continue until the reset */

bool chip_start(void) {
    bool watchdog_reset = ran_before == RAN_BEFORE;
    ran_before = RAN_BEFORE;
    reset_us = watchdog_reset ? fed_us + 2u * WATCHDOG_US : 0;
    uint32_t booted_us = REGISTER(FPGA_COUNTER) / CYCLES_PER_US; /* it counts cycles from the reset on */
    REGISTER(FPGA_PRESCALE) = CYCLES_PER_US - 1u;
    REGISTER(FPGA_COUNTER) = booted_us;
    REGISTER(WATCHDOG + WATCHDOG_LOAD) = WATCHDOG_US * CYCLES_PER_US;
    return watchdog_reset;
}

uint64_t chip_reset_us(void) { return reset_us; }

void chip_feed_watchdog(void) {
    REGISTER(WATCHDOG + WATCHDOG_CTRL) = 1u | 2u;
    REGISTER(WATCHDOG + WATCHDOG_CLEAR) = 1u; /* restarts it */
    fed_us = chip_now_us();
}

uint64_t chip_now_us(void) {
    static uint32_t last, wraps;
    uint32_t now = REGISTER(FPGA_COUNTER);
    wraps += now < last;
    last = now;
    return reset_us + ((uint64_t)wraps << 32 | now);
}

/* An interrupt would wait for a second thread of the emulator, ten thousand times per second. */
void chip_wait_until(uint64_t at_us) {
    for (uint64_t now_us; (now_us = chip_now_us()) < at_us;) {
        uint32_t turns = (uint32_t)(at_us - now_us) * TURNS_PER_US;
        __asm volatile("1: subs %0, #1\n bne 1b" : "+l"(turns) : : "cc");
    }
}
