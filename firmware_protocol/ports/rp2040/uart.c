#include "uart.h"

#include "chip.h"
#include "outgoing.h"
#include "outputs.h"
#include "pins.h"
#include "registers.h"
#include "settings.h"

#define RING 1024u /* a power of two */

/* The interrupts of UART and alarm have the same priority, so neither preempts the other. */
static struct {
    uint8_t bytes[RING];
    volatile uint32_t in, out;
    volatile bool break_received;
} received;

static bool is_selected;

static void fill_transmitter(void) {
    uint8_t byte;
    while (is_selected && !(REGISTER(UART_FR) & BIT(5)) && outgoing_take(&byte)) {
        REGISTER(UART_DR) = byte;
    }
}

void uart_isr(void) {
    REGISTER(UART_ICR) = 0x7ffu;
    while (!(REGISTER(UART_FR) & BIT(4))) {
        uint32_t byte = REGISTER(UART_DR);
        if (byte & BIT(10)) {
            received.break_received = true;
        } else if (received.in - received.out < RING) {
            received.bytes[received.in % RING] = (uint8_t)byte;
            received.in = received.in + 1;
        }
    }
    fill_transmitter();
}

void uart_start(void) {
    uint32_t divisor = CLOCK_HZ * 4u / HOST_BAUD; /* 64ths of 16 bit times */
    REGISTER(UART_IBRD) = divisor >> 6;
    REGISTER(UART_FBRD) = divisor & 63u;
    REGISTER(UART_LCR_H) = 3u << 5 | BIT(4);
    REGISTER(UART_CR) = BIT(0) | BIT(8) | BIT(9);
    REGISTER(UART_IFLS) = 1u << 3 | 1u; /* at a quarter, both directions */
    REGISTER(UART_IMSC) = BIT(4) | BIT(5) | BIT(6) | BIT(9);
    REGISTER(NVIC_ENABLE(UART_IRQ)) = NVIC_BIT(UART_IRQ);
}

bool uart_is_open(void) { return !outputs_get(PIN_HOST_CLOSED); }

size_t uart_read(uint8_t *bytes, size_t size) {
    size_t n = 0;
    bool ended = false;
    while (n < size && received.out != received.in && !ended) {
        bytes[n] = received.bytes[received.out % RING];
        received.out = received.out + 1;
        ended = bytes[n++] == 0;
    }
    return n;
}

void uart_skip(void) { received.out = received.in; }

bool uart_pop_break(void) {
    bool break_received = received.break_received;
    received.break_received = false;
    return break_received;
}

static void hold(void) {
    REGISTER(NVIC_DISABLE(UART_IRQ)) = NVIC_BIT(UART_IRQ);
    chip_fence();
}

static void release(void) {
    chip_fence();
    REGISTER(NVIC_ENABLE(UART_IRQ)) = NVIC_BIT(UART_IRQ);
}

void uart_select(bool selected) {
    hold();
    is_selected = selected;
    release();
}

void uart_send(const uint8_t *frame, size_t n) {
    hold();
    outgoing_add(frame, n);
    fill_transmitter();
    release();
}

void uart_discard(void) {
    hold();
    outgoing_discard();
    release();
}
