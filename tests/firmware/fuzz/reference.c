#include "reference.h"

#include <string.h>

static uint32_t compute_crc(const uint8_t *bytes, size_t n) {
    uint32_t crc = ~0u;
    for (size_t bit = 0; bit < 8 * n; bit++) {
        uint32_t low = (crc ^ (uint32_t)bytes[bit / 8] >> bit % 8) & 1u;
        crc = crc >> 1 ^ (low ? 0xedb88320u : 0);
    }
    return ~crc;
}

/* Decodes COBS; returns the length, or more than REFERENCE_RAW_MAX if the bytes are invalid. */
static size_t unpack(const uint8_t *bytes, size_t n, uint8_t *raw) {
    size_t length = 0, until_code = 0;
    for (size_t k = 0; k < n; k++) {
        bool is_code = until_code == 0;
        if (is_code && bytes[k] == 0xff) {
            return REFERENCE_RAW_MAX + 1;
        }
        until_code = is_code ? (size_t)bytes[k] - 1 : until_code - 1;
        if (is_code && k == 0) {
            continue;
        }
        if (length == REFERENCE_RAW_MAX) {
            return REFERENCE_RAW_MAX + 1;
        }
        raw[length++] = is_code ? 0 : bytes[k];
    }
    return until_code ? REFERENCE_RAW_MAX + 1 : length;
}

enum reading reference_decode(const uint8_t *bytes, size_t n, uint8_t *raw, struct parsed *parsed) {
    size_t length = n > REFERENCE_WIRE_MAX - 1 ? 0 : unpack(bytes, n, raw);
    if (length < 8 || length > REFERENCE_RAW_MAX) {
        return READ_FORMAT_ERROR;
    }
    if (compute_crc(raw, length - 4) != read_le(raw + length - 4, 4)) {
        return READ_CRC_ERROR;
    }
    *parsed = (struct parsed){raw[0], raw[1], (uint16_t)read_le(raw + 2, 2), raw + 4, length - 8};
    return READ_FRAME;
}

size_t reference_encode(uint8_t *wire, uint8_t type, uint8_t seq, uint16_t session, const uint8_t *body, size_t n) {
    uint8_t raw[REFERENCE_RAW_MAX] = {type, seq, (uint8_t)session, (uint8_t)(session >> 8)};
    if (n) {
        memcpy(raw + 4, body, n);
    }
    uint32_t crc = compute_crc(raw, n + 4);
    for (size_t k = 0; k < 4; k++) {
        raw[n + 4 + k] = (uint8_t)(crc >> 8 * k);
    }
    size_t left = n + 8, to = 0;
    for (const uint8_t *from = raw;;) { /* one run between zeros per iteration */
        size_t run = 0;
        while (run < left && from[run]) {
            run++;
        }
        wire[to++] = (uint8_t)(run + 1);
        memcpy(wire + to, from, run);
        to += run;
        if (run == left) {
            break;
        }
        from += run + 1;
        left -= run + 1;
    }
    wire[to++] = 0;
    return to;
}

/* From PROTOCOL.md: bytes of the body, bytes per item of 1 to `max_items` items, enumerated fields. */
static const struct {
    uint8_t type, size, item, max_items;
    bool sequenced;
    struct {
        uint8_t at, names;
    } named[3];
} MESSAGES[] = {
    {0x01, 6, 0, 0, false, {{0, 0}}},
    {0x02, 34, 0, 0, true, {{0, 0}}},
    {0x03, 4, 0, 0, false, {{0, 0}}},
    {0x04, 2, 0, 0, false, {{0, 0}}},
    {0x10, 4, 10, 24, true, {{0, 0}}},
    {0x11, 18, 0, 0, true, {{0, 0}}},
    {0x12, 8, 0, 0, true, {{0, 0}}},
    {0x13, 0, 0, 0, false, {{0, 0}}},
    {0x14, 4, 0, 0, true, {{0, 0}}},
    {0x15, 8, 0, 0, true, {{0, 0}}},
    {0x16, 0, 0, 0, true, {{0, 0}}},
    {0x17, 0, 0, 0, true, {{0, 0}}},
    {0x18, 0, 0, 0, false, {{0, 0}}},
    {0x19, 0, 0, 0, true, {{0, 0}}},
    {0x1a, 4, 0, 0, false, {{0, 0}}},
    {0x1b, 14, 0, 0, true, {{0, 0}}},
    {0x1c, 0, 0, 0, false, {{0, 0}}},
    {0x81, 77, 0, 0, false, {{0, 0}}},
    {0x83, 12, 0, 0, false, {{0, 0}}},
    {0x90, 8, 0, 0, false, {{7, 7}}},
    {0x91, 2, 0, 0, false, {{1, 8}}},
    {0x92, 11, 0, 0, false, {{0, 7}, {1, 17}, {2, 17}}},
    {0x94, 8, 0, 0, false, {{0, 0}}},
    {0x98, 41, 0, 0, false, {{0, 7}, {1, 17}}},
    {0x9c, 12, 0, 0, false, {{0, 0}}},
    {0x99, 12, 8, 28, false, {{0, 0}}},
};
#define MESSAGES_COUNT (sizeof MESSAGES / sizeof MESSAGES[0])

bool reference_is_valid(const struct parsed *parsed) {
    for (size_t k = 0; k < MESSAGES_COUNT; k++) {
        if (MESSAGES[k].type != parsed->type) {
            continue;
        }
        size_t rest = parsed->length - MESSAGES[k].size, item = MESSAGES[k].item;
        bool fits = parsed->length >= MESSAGES[k].size &&
                    (item ? rest >= item && rest <= item * MESSAGES[k].max_items && rest % item == 0 : rest == 0);
        for (size_t n = 0; fits && n < 3; n++) {
            uint8_t names = MESSAGES[k].named[n].names;
            fits = names == 0 || parsed->body[MESSAGES[k].named[n].at] < names;
        }
        return fits;
    }
    return false;
}

bool reference_is_sequenced(uint8_t type) {
    for (size_t k = 0; k < MESSAGES_COUNT; k++) {
        if (MESSAGES[k].type == type) {
            return MESSAGES[k].sequenced;
        }
    }
    return false;
}
