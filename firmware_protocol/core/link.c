/* Framing, message validation, and the receiving end of go-back-N. */

#include <string.h>

#include "core.h"

struct layout {
    uint8_t type;
    bool from_host, sequenced;
    uint8_t body, item, max_items;
    struct {
        uint8_t at, count;
    } names[3];
};

#define LAYOUT(type, host, sequenced, body, item, max_bytes, at0, n0, at1, n1, at2, n2) \
    {type, host, sequenced, body, item, max_bytes, {{at0, n0}, {at1, n1}, {at2, n2}}},
static const struct layout LAYOUTS[] = {MESSAGE_LAYOUTS(LAYOUT)};

/* Decodes the bytes between two zeros; returns false and counts an error if they are not a frame. */
static bool frame_decode(struct receiver *r, struct frame *frame) {
    size_t n = cobs_decode(r->bytes, r->length);
    if (n < FRAME_OVERHEAD) {
        r->format_errors++;
        return false;
    }
    size_t content = n - 4;
#if MUTANT != 13
    if (frame_crc32(r->bytes, content) != get_u32(r->bytes + content)) {
        r->crc_errors++;
        return false;
    }
#endif
    frame->type = r->bytes[0];
    frame->seq = r->bytes[1];
    frame->session = get_u16(r->bytes + 2);
    frame->body = r->bytes + 4;
    frame->length = content - 4;
    return true;
}

bool receiver_feed(struct receiver *r, uint8_t byte, struct frame *frame) {
    if (byte != 0) {
        if (r->overlong) {
            return false;
        }
        if (MUTANT != 102 && r->length == sizeof r->bytes) {
            r->format_errors++;
            r->overlong = true;
            return false;
        }
        r->bytes[r->length++] = byte;
        return false;
    }
    bool whole = !r->overlong && r->length > 0 && frame_decode(r, frame);
    r->length = 0;
    r->overlong = false;
    return whole;
}

bool frame_is_valid(const struct frame *frame, enum frame_class *class) {
    for (size_t k = 0; k < sizeof LAYOUTS / sizeof LAYOUTS[0]; k++) {
        const struct layout *layout = &LAYOUTS[k];
        if (layout->type != frame->type) {
            continue;
        }
        size_t rest = frame->length - layout->body;
        if (frame->length < layout->body || (layout->item ? rest == 0 || rest % layout->item != 0 : rest != 0) ||
            rest > (size_t)layout->item * layout->max_items) {
            return false;
        }
        for (size_t n = 0; n < 3; n++) {
            if (layout->names[n].count && frame->body[layout->names[n].at] >= layout->names[n].count) {
                return false;
            }
        }
        *class = !layout->from_host ? FRAME_NOT_ACCEPTED : layout->sequenced ? FRAME_SEQUENCED : FRAME_UNSEQUENCED;
        return true;
    }
    return false;
}

size_t frame_encode(uint8_t *wire, uint8_t type, uint8_t seq, uint16_t session, const uint8_t *body, size_t n) {
    uint8_t raw[RAW_MAX];
    if (n > BODY_MAX) {
        return 0;
    }
    raw[0] = type;
    raw[1] = seq;
    put_u16(raw + 2, session);
    if (n > 0) {
        memcpy(raw + 4, body, n);
    }
    put_u32(raw + 4 + n, frame_crc32(raw, 4 + n));
    size_t length = cobs_encode(wire, raw, n + FRAME_OVERHEAD);
    wire[length] = 0;
    return length + 1;
}

bool link_accept(struct link *link, uint8_t seq, uint8_t *refusal) {
    uint8_t ahead = (uint8_t)(seq - link->expected);
#if MUTANT == 103
    link->expected = seq;
    return true;
#endif
    if (ahead == 0) {
        return true;
    }
    if (ahead >= SEQ_MODULUS / 2) {
        *refusal = link->last_refusal;
        return false;
    }
    link->seq_errors++;
    *refusal = NAK_SEQUENCE;
    return false;
}

void link_mark_consumed(struct link *link, uint8_t refusal) {
    link->expected++;
    link->last_refusal = refusal;
}

void link_begin(struct link *link, uint16_t session) {
    link->session = session;
    link->expected = 0;
    link->last_refusal = NO_REFUSAL;
    link->ack_due = false;
}
