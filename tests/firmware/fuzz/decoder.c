/* Fuzz target: the core's receiver against the reference decoder, byte by byte.

   The first byte is the number of following pieces that become intact frames, since a fuzzer does not find a valid
   CRC. The core's own buffers are on the heap, each as large as it must be and no larger. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "reference.h"

#define STREAM_MAX 4096u

static void report_difference(const char *what) {
    fprintf(stderr, "decoder: %s\n", what);
    abort();
}

static void compare(const struct frame *core, const struct parsed *expected) {
    if (core->type != expected->type || core->seq != expected->seq || core->session != expected->session ||
        core->length != expected->length || (core->length && memcmp(core->body, expected->body, core->length))) {
        report_difference("another frame than the one that came");
    }
    uint8_t *body = malloc(core->length);
    struct frame alone = *core;
    if (core->length) {
        memcpy(body, core->body, core->length);
    }
    alone.body = body; /* allocated exactly, so that an overrun is detected */
    enum frame_class class;
    if (frame_is_valid(&alone, &class) != reference_is_valid(expected)) {
        report_difference("a form that is none, or refused one that is");
    }
    free(body);
}

/* Decodes the piece in a buffer of its exact size. */
static void unpack_alone(const uint8_t *piece, size_t n) {
    if (n <= RAW_MAX + 1) {
        uint8_t *alone = malloc(n);
        memcpy(alone, piece, n);
        cobs_decode(alone, n);
        free(alone);
    }
}

/* Compares the reference, piece by piece, with the core, byte by byte. */
static void run(const uint8_t *stream, size_t n) {
    struct receiver *receiver = calloc(1, sizeof *receiver);
    uint32_t format_errors = 0, crc_errors = 0;
    uint8_t raw[REFERENCE_RAW_MAX];
    for (size_t from = 0, at = 0; at < n; at++) {
        struct frame frame;
        struct parsed parsed;
        if (stream[at] == 0 && at > from) {
            unpack_alone(stream + from, at - from);
        }
        bool whole = receiver_feed(receiver, stream[at], &frame), expected = false;
        if (stream[at] == 0) {
            enum reading reading = at > from ? reference_decode(stream + from, at - from, raw, &parsed) : READ_FRAME;
            expected = at > from && reading == READ_FRAME;
            format_errors += at > from && reading == READ_FORMAT_ERROR;
            crc_errors += at > from && reading == READ_CRC_ERROR;
            from = at + 1;
            if (receiver->format_errors != format_errors || receiver->crc_errors != crc_errors) {
                report_difference("counters");
            }
        }
        if (whole != expected) {
            report_difference(whole ? "a frame where none came" : "a frame was lost");
        }
        if (whole) {
            compare(&frame, &parsed);
        }
    }
    free(receiver);
}

static size_t smaller(size_t a, size_t b) { return a < b ? a : b; }

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n) {
    uint8_t stream[STREAM_MAX + REFERENCE_WIRE_MAX];
    size_t length = 0, at = 1;
    for (uint8_t framed = n ? data[0] % 8 : 0; framed > 0 && at + 4 < n && length < STREAM_MAX; framed--) {
        size_t size = smaller(smaller(data[at + 2] | (size_t)data[at + 3] << 4, 244), n - at - 4);
        uint8_t *body = malloc(size), wire[REFERENCE_WIRE_MAX], *own = malloc(WIRE_MAX);
        if (size) {
            memcpy(body, data + at + 4, size);
        }
        size_t written = reference_encode(wire, data[at], data[at + 1], data[at + 2], body, size);
        if (frame_encode(own, data[at], data[at + 1], data[at + 2], body, size) != written ||
            memcmp(own, wire, written)) {
            report_difference("a frame is encoded otherwise");
        }
        memcpy(stream + length, wire, written);
        length += written;
        at += 4 + size;
        free(body);
        free(own);
    }
    size_t rest = smaller(n > at ? n - at : 0, STREAM_MAX - smaller(length, STREAM_MAX));
    if (rest) {
        memcpy(stream + length, data + at, rest);
    }
    run(stream, length + rest);
    return 0;
}
