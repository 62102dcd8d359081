#include "usb_buffers.h"

#include "registers.h"

#define BUFFER_BIT(endpoint, way) BIT(2u * (endpoint) + (way))

static uint32_t data1; /* BUFFER_BITs whose next packet is DATA1 */

/* The controller's slower clock must see the length before the bit that makes a buffer available. */
void buffer_arm(uint32_t endpoint, enum way way, uint32_t length) {
    uint32_t address = USB_BUFFER_CONTROL(endpoint, way), bit = BUFFER_BIT(endpoint, way);
    uint32_t word = length | (way == IN ? USB_BUFFER_FULL : 0) | ((data1 & bit) ? USB_BUFFER_DATA1 : 0);
    data1 ^= bit;
    REGISTER(address) = word;
    for (uint32_t k = 0; k < 4; k++) {
        __asm volatile("nop\n\tnop\n\tnop");
    }
    REGISTER(address) = word | USB_BUFFER_AVAILABLE;
}

void buffer_take_back(uint32_t endpoint, enum way way) {
    REGISTER(USB_BUFFER_CONTROL(endpoint, way)) = 0;
    CLEAR(USB_BUFFER_STATUS) = BUFFER_BIT(endpoint, way);
}

bool buffer_pop_done(uint32_t endpoint, enum way way) {
    bool done = REGISTER(USB_BUFFER_STATUS) & BUFFER_BIT(endpoint, way);
    if (done) {
        CLEAR(USB_BUFFER_STATUS) = BUFFER_BIT(endpoint, way);
    }
    return done;
}

uint32_t buffer_length(uint32_t endpoint, enum way way) {
    return REGISTER(USB_BUFFER_CONTROL(endpoint, way)) & USB_BUFFER_LENGTH;
}

void buffer_count_from(uint32_t endpoint, enum way way, uint32_t number) {
    data1 &= ~BUFFER_BIT(endpoint, way);
    data1 |= number ? BUFFER_BIT(endpoint, way) : 0;
}
