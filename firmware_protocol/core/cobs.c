/* COBS for frames of at most RAW_MAX bytes, so that a code byte never reaches 0xff. */

#include "core.h"

size_t cobs_encode(uint8_t *encoded, const uint8_t *raw, size_t n) {
    size_t code_at = 0, to = 1;
    for (size_t k = 0; k < n; k++) {
        if (raw[k] == 0) {
            encoded[code_at] = (uint8_t)(to - code_at);
            code_at = to++;
        } else {
            encoded[to++] = raw[k];
        }
    }
    encoded[code_at] = (uint8_t)(to - code_at);
    return to;
}

size_t cobs_decode(uint8_t *bytes, size_t n) {
    size_t from = 0, to = 0;
    while (from < n) {
        size_t code = bytes[from];
#if MUTANT == 101
        if (code == 0 || code > RAW_MAX + 1) {
#else
        if (code == 0 || code > RAW_MAX + 1 || from + code > n) {
#endif
            return 0;
        }
        if (from > 0) {
            bytes[to++] = 0;
        }
        for (size_t k = 1; k < code; k++) {
            bytes[to++] = bytes[from + k];
        }
        from += code;
    }
    return to <= RAW_MAX ? to : 0;
}
