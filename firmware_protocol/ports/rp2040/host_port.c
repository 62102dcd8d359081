#include "host_port.h"

#include "chip.h"
#include "outgoing.h"
#include "uart.h"
#include "usb.h"

static volatile enum { NONE, UART, USB } holder; /* the tick sends, too */

void host_start(const uint8_t *uid) {
    uart_start();
    usb_start(uid);
}

/* What was outgoing belongs to the last holder. A zero ends what its host may have received of a frame. */
static void hand_over(void) {
    static const uint8_t DELIMITER[] = {0};
    holder = NONE;
    uart_select(false);
    chip_hold_alarm();
    outgoing_clear();
    outgoing_add(DELIMITER, sizeof DELIMITER);
    chip_release_alarm();
    if (uart_is_open()) {
        uart_select(true);
        holder = UART;
    } else if (usb_is_open()) {
        holder = USB;
    }
}

bool host_serve(void) {
    usb_serve();
    bool uart_broke = uart_pop_break(), usb_broke = usb_pop_break();
    if (holder == NONE) {
        uart_skip();
        usb_skip();
        hand_over();
        return false;
    }
    bool is_uart = holder == UART, is_open = is_uart ? uart_is_open() : usb_is_open();
    if (is_uart) {
        usb_skip();
    } else {
        uart_skip();
        usb_transmit();
    }
    if (!is_open) {
        holder = NONE;
    }
    return !is_open || (is_uart ? uart_broke : usb_broke);
}

size_t host_read(uint8_t *bytes, size_t size) {
    if (holder == NONE) {
        return 0;
    }
    return holder == UART ? uart_read(bytes, size) : usb_read(bytes, size);
}

void host_send(const uint8_t *frame, size_t n) {
    if (holder == UART) {
        uart_send(frame, n);
    } else if (holder == USB) {
        outgoing_add(frame, n);
    }
}

void host_discard_output(void) {
    if (holder == UART) {
        uart_discard();
    } else if (holder == USB) {
        outgoing_discard();
    }
}
