/* Reference implementation of framing, written from PROTOCOL.md and independent of the core. */

#ifndef REFERENCE_H
#define REFERENCE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define REFERENCE_RAW_MAX 252u
#define REFERENCE_WIRE_MAX 254u

enum reading { READ_FRAME, READ_FORMAT_ERROR, READ_CRC_ERROR };

struct parsed {
    uint8_t type, seq;
    uint16_t session;
    const uint8_t *body;
    size_t length;
};

/* Decodes the bytes between two zeros. raw: buffer of REFERENCE_RAW_MAX bytes, to which parsed->body points. */
enum reading reference_decode(const uint8_t *bytes, size_t n, uint8_t *raw, struct parsed *parsed);
/* Encodes a frame with its delimiter. wire: buffer of REFERENCE_WIRE_MAX bytes; n: at most 244. */
size_t reference_encode(uint8_t *wire, uint8_t type, uint8_t seq, uint16_t session, const uint8_t *body, size_t n);
/* Returns whether type, length and enumerations are those of a message. */
bool reference_is_valid(const struct parsed *parsed);
/* Returns whether a host's message is sequenced. */
bool reference_is_sequenced(uint8_t type);

static inline uint64_t read_le(const uint8_t *at, size_t bytes) {
    uint64_t value = 0;
    while (bytes--) {
        value = value << 8 | at[bytes];
    }
    return value;
}

#endif
