/* Encoding of limits, and guard B10: limits only tighten. */

#include "core.h"

void limits_decode(struct board_limits *limits, const uint8_t *from) {
#define GET(name, bits, at, way) limits->name = get_u##bits(from + at);
    LIMITS_FIELDS(GET)
#undef GET
}

void limits_encode(const struct board_limits *limits, uint8_t *to) {
#define PUT(name, bits, at, way) put_u##bits(to + at, limits->name);
    LIMITS_FIELDS(PUT)
#undef PUT
}

void limits_tighten(struct board_limits *limits, const struct board_limits *requested) {
#if MUTANT == 10
#define LESS(name) true
#define MORE(name) true
#else
#define LESS(name) (requested->name < limits->name)
#define MORE(name) (requested->name > limits->name)
#endif
#define FIXED(name) false
#define TIGHTEN(name, bits, at, way) \
    if (way(name)) { \
        limits->name = requested->name; \
    }
    LIMITS_FIELDS(TIGHTEN)
#undef TIGHTEN
}
