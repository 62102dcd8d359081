#include "chip.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define UART_AT(n) (0x40004000u + 0x1000u * (n))
#define UART_DATA 0x0u
#define UART_STATE 0x4u /* bit 0: transmitter full, bit 1: receiver full */
#define UART_CTRL 0x8u
#define UART_CLEAR 0xcu
#define UART_DIVIDER 0x10u
#define TIMER0 0x40000000u
#define TIMER_CTRL 0x0u
#define TIMER_VALUE 0x4u
#define TIMER_RELOAD 0x8u
#define TIMER_CLEAR 0xcu
#define WATCHDOG 0x40008000u
#define WATCHDOG_LOAD 0x0u
#define WATCHDOG_CTRL 0x8u
#define WATCHDOG_CLEAR 0xcu
#define FPGA_COUNTER 0x40028018u
#define FPGA_PRESCALE 0x4002801cu
#define NVIC_ENABLE 0xe000e100u
#define TIMER0_IRQ 8u

#define CLOCK_HZ 25000000u
#define CYCLES_PER_US (CLOCK_HZ / 1000000u)
#define SLEEP_MAX_US 5000u /* longer than a chip's tick of 100 µs, to keep the load of the emulator low */
#define WATCHDOG_MS 3000u  /* to its interrupt, which is not handled, and again to the reset; fault TICK comes first */
#define RING 65536u        /* a power of two */
#define RAN_BEFORE 0x52414e21u

/* Not cleared at reset: marks that the program ran since power-up, so the reset came from the watchdog. */
__attribute__((section(".noinit"))) static volatile uint32_t ran_before;

static struct {
    uint8_t bytes[RING];
    volatile uint32_t in, out;
} rings[UARTS];

static void drain_uart(enum uart uart) {
    uint32_t at = UART_AT(uart);
    REGISTER(at + UART_CLEAR) = 2u;
    while (REGISTER(at + UART_STATE) & 2u) {
        uint8_t byte = (uint8_t)REGISTER(at + UART_DATA);
        if (rings[uart].in - rings[uart].out < RING) {
            rings[uart].bytes[rings[uart].in++ % RING] = byte;
        }
    }
}

void uart0_isr(void) { drain_uart(UART_HOST); }
void uart1_isr(void) { drain_uart(UART_WITNESS); }
void uart2_isr(void) { drain_uart(UART_BENCH); }
void timer0_isr(void) { REGISTER(TIMER0 + TIMER_CLEAR) = 1u; }

bool chip_start(void) {
    bool watchdog_reset = ran_before == RAN_BEFORE;
    ran_before = RAN_BEFORE;
    REGISTER(FPGA_PRESCALE) = CYCLES_PER_US - 1u;
    for (uint32_t k = 0; k < UARTS; k++) {
        REGISTER(UART_AT(k) + UART_DIVIDER) = 16u;
        REGISTER(UART_AT(k) + UART_CTRL) = 1u | 2u | 8u; /* both directions; an interrupt per received byte */
        (void)REGISTER(UART_AT(k) + UART_DATA); /* a byte received before the receiver was enabled would block it */
        REGISTER(NVIC_ENABLE) = 1u << (2u * k);
    }
    REGISTER(TIMER0 + TIMER_RELOAD) = REGISTER(TIMER0 + TIMER_VALUE) = SLEEP_MAX_US * CYCLES_PER_US;
    REGISTER(TIMER0 + TIMER_CTRL) = 1u | 8u;
    REGISTER(NVIC_ENABLE) = 1u << TIMER0_IRQ;
    REGISTER(WATCHDOG + WATCHDOG_LOAD) = WATCHDOG_MS * (CLOCK_HZ / 1000u);
    return watchdog_reset;
}

void chip_feed_watchdog(void) {
    REGISTER(WATCHDOG + WATCHDOG_CTRL) = 1u | 2u; /* enabled by the first feed, since the bench may be slow before it */
    REGISTER(WATCHDOG + WATCHDOG_CLEAR) = 1u;
}

uint64_t chip_now_us(void) {
    static uint32_t last, wraps;
    uint32_t now = REGISTER(FPGA_COUNTER); /* not counted from ticks, which may be merged */
    wraps += now < last;
    last = now;
    return (uint64_t)wraps << 32 | now;
}

void chip_sleep(uint64_t until_us, bool host) {
    uint64_t now_us = chip_now_us(), left_us = until_us > now_us ? until_us - now_us : 0;
    /* Interrupts are masked between the check and the sleep; a pending interrupt still ends the sleep. */
    __asm volatile("cpsid i" ::: "memory");
    bool is_empty = (!host || rings[UART_HOST].in == rings[UART_HOST].out) && rings[UART_BENCH].in == rings[UART_BENCH].out;
    if (is_empty && left_us > 0) {
        REGISTER(TIMER0 + TIMER_VALUE) = (uint32_t)(left_us < SLEEP_MAX_US ? left_us : SLEEP_MAX_US) * CYCLES_PER_US;
        __asm volatile("wfi" ::: "memory");
    }
    __asm volatile("cpsie i" ::: "memory");
}

size_t chip_read(enum uart uart, uint8_t *bytes, size_t size) {
    size_t n = 0;
    while (n < size && rings[uart].out != rings[uart].in) {
        bytes[n++] = rings[uart].bytes[rings[uart].out % RING];
        rings[uart].out = rings[uart].out + 1u;
    }
    return n;
}

void chip_write(enum uart uart, const uint8_t *bytes, size_t n) {
    for (size_t k = 0; k < n; k++) {
        while (REGISTER(UART_AT(uart) + UART_STATE) & 1u) {
        }
        REGISTER(UART_AT(uart) + UART_DATA) = bytes[k];
    }
}

void chip_flush(enum uart uart) {
    while (REGISTER(UART_AT(uart) + UART_STATE) & 1u) {
    }
}
