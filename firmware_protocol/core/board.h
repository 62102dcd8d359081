/* Portable implementation of the board in PROTOCOL.md: no allocation, no globals, no blocking. The caller owns one
   struct board and one struct board_hal, calls board_tick from a timer and board_receive from the main loop; see
   README.md. */

#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "messages.h"

/* Sizes: define smaller ones for a chip with less memory. If a table is full, the board refuses or faults. */
#ifndef BOARD_QUEUE_POINTS
#define BOARD_QUEUE_POINTS 4096u /* 10 bytes each */
#endif
#ifndef BOARD_RECORDS
#define BOARD_RECORDS EXECUTED_RING /* 16 bytes each */
#endif
#ifndef BOARD_PULSES
#define BOARD_PULSES 8192u /* pulses within a second, 8 bytes each; more: fault PULSES */
#endif
#ifndef BOARD_CELLS
#define BOARD_CELLS 2048u /* warm cells in each of four grids, 20 bytes each, at most 65534; more: fault CELLS */
#endif
#define BOARD_BUCKETS 1024u /* of the hash table of each grid, 2 bytes each, a power of two */

#define BOARD_TICK_US 100u       /* maximum period of board_tick */
#ifndef BOARD_TICK_LATE_US
#define BOARD_TICK_LATE_US 500u  /* a tick later than this is fault TICK */
#endif
#define BOARD_HEAD_US 50u         /* a head without a valid status for longer is not ready */
#define BOARD_READBACK_US 100u   /* a gate that differs from its command for longer is fault READBACK */

/* An event for a log. */
enum board_trace_kind { TRACE_GATE, TRACE_STATE, TRACE_FAULT, TRACE_PULSE, TRACE_RX_ERROR };

struct board_trace {
    uint64_t at_us;
    enum board_trace_kind kind;
    bool on, is_point;      /* gate: command, and whether a point caused it, else reason */
    uint8_t state, before;  /* state */
    uint8_t reason, fault;  /* gate and state; fault */
    uint16_t x, y, duty;    /* pulse */
    uint32_t index;         /* point's number, of gate and pulse; rx_error: bad frames since power-up */
    uint64_t on_us, off_us; /* pulse: times of the gate's edges */
};

/* Functions of a port; README.md states what each must guarantee. */
struct board_hal {
    void *context;
    void (*set_gate)(void *context, bool on, uint16_t duty);
    bool (*read_gate)(void *context);
    void (*move_mirrors)(void *context, uint16_t x, uint16_t y);
    uint8_t (*read_inputs)(void *context); /* INPUT_ bits */
    /* Whether a valid status of the scan head came since the last call, and its word; never called on an analog board. */
    bool (*read_head)(void *context, uint16_t *status);
    /* The mirrors' measured positions in codes, also beyond 0 to 65535; never called without feedback_codes. */
    void (*read_position)(void *context, int32_t *x, int32_t *y);
    uint32_t (*read_triggers)(void *context, uint64_t *last_us); /* edges so far, and the time of the last one if any */
    void (*set_indicator)(void *context, bool on);
    void (*set_relay)(void *context, bool closed);
    uint32_t (*read_entropy)(void *context);
    int16_t (*read_temperature_dc)(void *context);
    void (*send)(void *context, const uint8_t *frame, size_t length); /* all of the frame or nothing */
    void (*discard_output)(void *context); /* all frames not yet begun */
    void (*feed_watchdog)(void *context);
    void (*hold_tick)(void *context, bool hold); /* NULL if board_receive is never interrupted by board_tick */
    void (*trace)(void *context, const struct board_trace *event); /* may be NULL */
    bool has_exact_widths; /* at the output every pulse lasts its on_us, to within 2 µs */
};

#define LIMIT_MEMBER(name, bits, at, way) uint##bits##_t name;
struct board_limits {
    LIMITS_FIELDS(LIMIT_MEMBER)
};
#undef LIMIT_MEMBER

/* How the board tells the mirrors their position. */
enum interface { INTERFACE_ANALOG, INTERFACE_XY2_100 };

struct board_config {
    struct board_limits limits;
    uint8_t uid[12];
    uint32_t firmware;
    uint16_t cell_codes;   /* at least 1 */
    uint16_t queue_points; /* at least DATA_ITEMS_MAX; BOARD_QUEUE_POINTS where it states more */
    uint16_t cells, window_pulses; /* at least 1; BOARD_CELLS and BOARD_PULSES where they state more */
    bool key_edge;
    uint8_t interface; /* enum interface */
    uint16_t feedback_codes; /* a measured position this far from the commanded one is fault SCAN; 0: none is measured */
};

enum reset_cause { RESET_POWER_UP, RESET_RESET, RESET_BROWN_OUT, RESET_WATCHDOG };

/* --- state of a board; ports and tests may read it, not write it --- */

struct point {
    uint16_t x, y, dark_us, on_us, duty;
};

struct queue {
    struct point points[BOARD_QUEUE_POINTS];
    uint32_t first, count;
};

struct record {
    uint64_t on_tick;
    uint32_t number;
    uint16_t on_ticks, duty;
};

struct records {
    struct record ring[BOARD_RECORDS];
    uint32_t total, reported; /* counts of the session */
};

/* The times of pulses and cells are the low words of µs: guards_tick removes or moves them long before they wrap. */
struct pulse {
    uint32_t start_us;
    uint16_t on_us, duty;
};

struct cell {
    uint32_t since_us; /* begin of the last pulse */
    uint32_t key, level_uj;
    uint16_t on_us, last_on_us;
    uint16_t next; /* place of the next cell in the bucket, or of the next free one; 0: none */
    bool used;
};

/* The cells of one grid: a hash table whose buckets are lists. A place is the index in cells + 1. */
struct grid {
    struct cell cells[BOARD_CELLS];
    uint16_t buckets[BOARD_BUCKETS];
    uint16_t touched, free, count, swept; /* places ever used; first free one; cells in use; last one swept */
};

struct guards {
    struct grid grids[4];
    struct pulse pulses[BOARD_PULSES];
    uint32_t first, count, turn;
    uint64_t sum;
};

struct receiver {
    uint8_t bytes[RAW_MAX + 1];
    uint16_t length;
    bool overlong;
    uint32_t crc_errors, format_errors;
};

struct link {
    struct receiver receiver;
    uint32_t seq_errors;
    uint16_t session;
    uint8_t expected, last_refusal;
    bool ack_due;
};

struct job {
    uint64_t start_us; /* while it awaits a trigger: when it gives up */
    uint64_t accepted_us;
    uint32_t number, end_index, delay_us;
    uint16_t watermark;
    bool active, has_end, awaits_trigger;
};

struct board {
    struct board_hal hal;
    struct board_config config;
    struct board_limits limits;
    uint64_t now_us, epoch_us;
    uint8_t state, fault, reset_cause, inputs;

    struct link link;
    struct queue queue;
    struct records records;
    struct guards guards;

    struct job job;
    struct point current_point;
    uint32_t current_index;
    bool has_current_point, gate;
    uint64_t gate_on_us, due_us, settled_us;
    uint16_t x, y;
    uint32_t next_index, done_index;

    uint64_t lease_until_us, arming_since_us, hold_since_us;
    uint64_t trigger_us; /* of the last edge */
    uint32_t triggers_read, triggers_before; /* edges that the port has counted, and had at power-up or reset */
    uint32_t board_nonce, host_nonce;
    bool nonce_valid, confirmed, key_turned, version_supported;

    uint64_t underruns_us[UNDERRUNS_MAX];
    uint32_t underruns_count, underruns_total;
    uint64_t laser_on_duty_us; /* µs × duty */

    uint64_t head_us; /* of the tick that read its last status */
    uint16_t head;    /* the status, 0: none */

    int32_t measured_x, measured_y; /* of the mirrors, codes */
    bool follows;                   /* both mirrors, when last measured and settled */

    uint64_t last_tick_us, readback_at_us;
    uint64_t readback_differs_us[2]; /* by commanded level: how long it has differed since it last agreed */
    bool readback_differs, loop_ran, has_ticked;
};

/* Power-up or reset: initialises all state, gate off, DISARMED. now_us: a monotonic 64-bit time in µs. */
void board_init(struct board *b, const struct board_hal *hal, const struct board_config *config,
                enum reset_cause cause, uint64_t now_us);

/* The safety tick: checks tick and readback, carries out due events, checks inputs, feeds the watchdog. */
void board_tick(struct board *b, uint64_t now_us);

/* One iteration of the main loop: processes n bytes, answers and reports; also call it with n = 0. */
void board_receive(struct board *b, const uint8_t *bytes, size_t n, uint64_t now_us);

/* Link lost (BREAK, DTR dropped, cable unplugged): acts as ABORT. */
void board_on_link_lost(struct board *b, uint64_t now_us);

/* Time of the next due event, UINT64_MAX if there is none, for a port with a programmable timer. */
uint64_t board_next_due_us(const struct board *b);

#endif
