#include "outgoing.h"

#define RING 4096u /* a power of two */

static struct {
    uint8_t bytes[RING];
    uint32_t in, out;
    bool mid_frame;
} outgoing;

void outgoing_add(const uint8_t *frame, size_t n) {
    if (RING - (outgoing.in - outgoing.out) < n) {
        return;
    }
    for (size_t k = 0; k < n; k++) {
        outgoing.bytes[outgoing.in++ % RING] = frame[k];
    }
}

bool outgoing_take(uint8_t *byte) {
    if (outgoing.out == outgoing.in) {
        return false;
    }
    *byte = outgoing.bytes[outgoing.out++ % RING];
    outgoing.mid_frame = *byte != 0;
    return true;
}

void outgoing_discard(void) {
    uint32_t end = outgoing.out;
    if (outgoing.mid_frame) {
        while (outgoing.bytes[end % RING] != 0) {
            end++;
        }
        end++;
    }
    outgoing.in = end;
}

void outgoing_clear(void) {
    outgoing.out = outgoing.in;
    outgoing.mid_frame = false;
}
