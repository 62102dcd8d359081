/* Fuzz target: a whole board with arbitrary host, inputs and clock, checked by the oracle.

   The fuzzer's bytes are steps: frames, mostly with valid framing, sequence number and session so that they pass the
   link; waits; input changes; damage. The first byte selects the board and whether it is already armed: each board is
   armed once by a real exchange, and its state is saved and restored. */

#include <stdlib.h>
#include <string.h>

#include "oracle.h"

#define STEPS_MAX 100u
#define TICKS_MAX 6000u /* per run */
#define SLOW_TICK_US 500u
#define BOARDS (sizeof BOARDS_LIMITS / sizeof BOARDS_LIMITS[0])
#define COUNT(list) (sizeof(list) / sizeof *(list))

struct driver {
    struct oracle oracle;
    uint64_t ticked_us;
    uint64_t trigger_us;
    uint32_t entropy, ticks, triggers;
    bool stuck, stuck_on;
};

static struct driver driver, armed_drivers[8];
static struct board *board, *armed_boards[8];
static struct oracle *const o = &driver.oracle;

/* --- boards --- */

#define OWN(...) {.max_on_us = 50000, .max_duty = 65535, .mean_duty = 65535, .spot_uj = 150000, .spot_leak_uw = 1400000, \
    .full_power_uw = 2450000, .x_max = 65535, .y_max = 65535, .settle_us = 200, .settle_ns_per_code = 50, \
    .rest_us = 500, .lease_ms = 100, __VA_ARGS__}
#pragma clang diagnostic ignored "-Winitializer-overrides"
static const struct board_config BOARDS_LIMITS[] = {
    {.limits = OWN(.lease_ms = 100), .cell_codes = 1300, .queue_points = 64, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES},
    {.limits = OWN(.lease_ms = 60000), .cell_codes = 1300, .queue_points = 64, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES},
    {.limits = OWN(.lease_ms = 60000, .mean_duty = 1500, .settle_us = 0, .settle_ns_per_code = 0), .cell_codes = 1300,
     .queue_points = 64, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES},
    {.limits = OWN(.lease_ms = 60000, .spot_uj = 20000, .rest_us = 0), .cell_codes = 7, .queue_points = 30, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES},
    {.limits = OWN(.lease_ms = 60000, .spot_leak_uw = 0, .max_on_us = 65535), .cell_codes = 65535, .queue_points = 24, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES},
    {.limits = OWN(.lease_ms = 1000, .x_max = 50000, .settle_ns_per_code = 2000), .cell_codes = 1, .queue_points = 64, .cells = BOARD_CELLS, .window_pulses = BOARD_PULSES,
     .key_edge = true, .interface = INTERFACE_XY2_100},
};

/* --- the HAL --- */

static void set_gate(void *context, bool on, uint16_t duty) {
    (void)context;
    oracle_on_gate(o, on, duty);
}
static bool read_gate(void *context) {
    (void)context;
    bool level = driver.stuck ? driver.stuck_on : o->gate_on;
    oracle_on_readback(o, level);
    return level;
}
static void move_mirrors(void *context, uint16_t x, uint16_t y) {
    (void)context;
    oracle_on_mirrors(o, x, y);
}
static uint8_t read_inputs(void *context) {
    (void)context;
    return o->inputs & (uint8_t)~HEAD_READY;
}
static bool read_head(void *context, uint16_t *status) {
    (void)context;
    *status = o->inputs & HEAD_READY ? 0xfdfdu : 0x7d7du;
    return true;
}
static uint32_t read_triggers(void *context, uint64_t *last_us) {
    (void)context;
    *last_us = driver.trigger_us;
    return driver.triggers;
}
static void set_indicator(void *context, bool on) {
    (void)context;
    o->indicator = on;
}
static void set_relay(void *context, bool closed) {
    (void)context;
    o->relay = closed;
}
static uint32_t read_entropy(void *context) {
    (void)context;
    driver.entropy = driver.entropy * 1664525u + 1013904223u;
    return driver.entropy ^ driver.entropy >> 16;
}
static int16_t read_temperature_dc(void *context) {
    (void)context;
    return 250;
}
static void send(void *context, const uint8_t *frame, size_t n) {
    (void)context;
    oracle_on_send(o, frame, n);
}
static void discard_output(void *context) { (void)context; }
static void feed_watchdog(void *context) {
    (void)context;
    oracle_on_feed(o);
}

static const struct board_hal HAL = {.set_gate = set_gate,
                                     .read_gate = read_gate,
                                     .move_mirrors = move_mirrors,
                                     .read_inputs = read_inputs,
                                     .read_head = read_head,
                                     .read_triggers = read_triggers,
                                     .set_indicator = set_indicator,
                                     .set_relay = set_relay,
                                     .read_entropy = read_entropy,
                                     .read_temperature_dc = read_temperature_dc,
                                     .send = send,
                                     .discard_output = discard_output,
                                     .feed_watchdog = feed_watchdog};

/* --- time --- */

static void tick(void) {
    uint64_t since_us = o->now_us - driver.ticked_us;
    driver.ticked_us = o->now_us;
    driver.ticks++;
    board_tick(board, o->now_us);
    oracle_check(o, board);
    oracle_after_tick(o, since_us);
}

static void power_up(const struct board_config *config) {
    oracle_power_up(o, config, o->now_us);
    board_init(board, &HAL, config, RESET_POWER_UP, o->now_us);
    oracle_check(o, board);
    driver.ticked_us = o->now_us; /* from the first tick on, a tick can be late */
    tick();
}

static void run_loop(const uint8_t *bytes, size_t n) {
    o->loop_ran = true;
    board_receive(board, bytes, n, o->now_us);
    oracle_check(o, board);
}

/* Runs ticks at due events and at least at the required rate; loop: whether the main loop runs too. */
static void wait(uint64_t us, bool loop) {
    uint64_t until_us = o->now_us + us;
    while (o->now_us < until_us && driver.ticks < TICKS_MAX) {
        uint64_t next_us = driver.ticked_us + (board->state == STATE_RUNNING ? TICK_MAX_US : SLOW_TICK_US);
        uint64_t due_us = board_next_due_us(board);
        next_us = due_us > o->now_us && due_us < next_us ? due_us : next_us;
        o->now_us = next_us < until_us ? next_us : until_us;
        tick();
        if (loop) {
            run_loop(NULL, 0);
        }
    }
}

static void late_tick(uint64_t us) {
    o->late_us += us;
    o->now_us += us;
    tick();
}

/* --- frames --- */

static void require_unchanged(const struct board *before) {
    struct board *now = malloc(sizeof *now);
    memcpy(now, board, sizeof *now);
    now->link.receiver = before->link.receiver;
    now->link.seq_errors = before->link.seq_errors;
    now->loop_ran = before->loop_ran;
    if (memcmp(now, before, sizeof *now) || o->answered) {
        report_violation("B13", "junk does more than count");
    }
    free(now);
}

/* Passes bytes; nothing: whether the oracle expects no effect. */
static void send_bytes(const uint8_t *wire, size_t n, bool nothing) {
    struct board *before = nothing ? malloc(sizeof *before) : NULL;
    run_loop(NULL, 0);
    o->answered = false;
    if (before) {
        memcpy(before, board, sizeof *before);
    }
    run_loop(wire, n);
    if (before) {
        require_unchanged(before);
    }
    free(before);
}

static void send_frame_as(uint8_t type, uint8_t seq, uint16_t session, const uint8_t *body, size_t n) {
    uint8_t wire[REFERENCE_WIRE_MAX];
    struct parsed frame = {type, seq, session, body, n};
    size_t length = reference_encode(wire, type, seq, session, body, n);
    oracle_on_frame(o, &frame);
    send_bytes(wire, length, o->changes_nothing);
}

static void send_frame(uint8_t type, const uint8_t *body, size_t n) {
    send_frame_as(type, reference_is_sequenced(type) ? o->next_seq : 0, o->session, body, n);
}

static void put(uint8_t **at, uint64_t value, size_t bytes) {
    while (bytes--) {
        *(*at)++ = (uint8_t)value;
        value >>= 8;
    }
}

static void hello(uint8_t major) {
    uint8_t body[6] = {major, 0, 1, 2, 3, 4};
    send_frame(0x01, body, sizeof body);
}

static void lease(uint16_t ms) {
    uint8_t body[2] = {(uint8_t)ms, (uint8_t)(ms >> 8)};
    send_frame(0x04, body, sizeof body);
}

static void arm_request(void) {
    uint8_t body[4] = {9, 8, 7, 6};
    send_frame(0x14, body, sizeof body);
}

static void arm_confirm(uint32_t host_nonce, uint32_t board_nonce) {
    uint8_t body[8], *at = body;
    put(&at, host_nonce, 4);
    put(&at, board_nonce, 4);
    send_frame(0x15, body, sizeof body);
}

static void start(uint32_t first, uint64_t tick, uint16_t watermark) {
    uint8_t body[18], *at = body;
    put(&at, o->job, 4);
    put(&at, first, 4);
    put(&at, tick, 8);
    put(&at, watermark, 2);
    send_frame(0x11, body, sizeof body);
}

static void start_on_trigger(uint8_t how) {
    uint8_t body[14], *at = body;
    put(&at, o->job, 4);
    put(&at, o->queue_count ? o->queue[o->queue_first % POINTS_MAX].index : o->next_index, 4);
    put(&at, 100u * (how & 15u), 4);
    put(&at, how >> 4, 2);
    send_frame(0x1b, body, sizeof body);
}

static void end(uint32_t index) {
    uint8_t body[8], *at = body;
    put(&at, o->job, 4);
    put(&at, index, 4);
    send_frame(0x12, body, sizeof body);
}

/* --- the fuzzer's bytes --- */

static const uint8_t *input, *input_end;

static uint8_t read_u8(void) { return input < input_end ? *input++ : 0; }
static uint16_t read_u16(void) {
    uint16_t low = read_u8();
    return (uint16_t)(low | read_u8() << 8);
}

static void choose_point(uint8_t *to) {
    static const uint16_t CODES[] = {32768, 32767, 32768, 33000, 34000, 0, 50000, 65535};
    static const uint16_t DARK[] = {0, 100, 400, 500, 1000, 3000, 20000, 60000};
    static const uint16_t ON[] = {1000, 0, 1, 200, 5000, 20000, 30000, 50000};
    static const uint16_t DUTY[] = {20000, 0, 1000, 3000, 30000, 40000, 65534, 65535};
    uint16_t chosen = read_u16();
    if (chosen >> 12 == 15) { /* any */
        for (size_t k = 0; k < 10; k++) {
            *to++ = read_u8();
        }
        return;
    }
    put(&to, CODES[chosen & 7], 2);
    put(&to, CODES[chosen >> 12 & 3], 2);
    put(&to, DARK[chosen >> 3 & 7], 2);
    put(&to, ON[chosen >> 6 & 7], 2);
    put(&to, DUTY[chosen >> 9 & 7], 2);
}

static void data(uint32_t first, size_t count) {
    uint8_t body[4 + 10 * 24], *at = body;
    put(&at, first, 4);
    for (size_t k = 0; k < count; k++) {
        choose_point(body + 4 + 10 * k);
    }
    send_frame(0x10, body, 4 + 10 * count);
}

static void play(void) {
    uint8_t how = read_u8();
    uint32_t first = o->queue_count ? o->queue[o->queue_first % POINTS_MAX].index : o->next_index;
    data(o->next_index, how % 4u + 1u);
    start(first, 0, how >> 4 & 3);
    if (how & 4) {
        end(o->next_index);
    }
}

static void limits(void) {
    uint8_t body[34], *at = body;
    static const uint16_t AT[] = {0, 2, 4, 6, 10, 18, 20, 22, 24, 26, 28, 30, 32};
    static const uint16_t VALUES[] = {100, 1000, 5000, 20000, 32000, 33000, 40000, 65535};
    memset(body, 0xff, sizeof body); /* loosest values */
    for (size_t k = 18; k < 32; k++) {
        body[k] = k / 2 == 10 || k / 2 == 12 ? 0xff : 0;
    }
    uint8_t which = read_u8();
    at += AT[which % COUNT(AT)];
    bool wide = which % COUNT(AT) == 3 || which % COUNT(AT) == 4;
    put(&at, VALUES[which >> 5], wide ? 4 : 2);
    send_frame(0x02, body, sizeof body);
}

/* Sends a frame of any type and content, often with a valid sequence number and session. */
static void send_random_frame(void) {
    uint8_t body[244], how = read_u8(), type = read_u8(), n = how & 16 ? read_u8() : 4;
    n = n > sizeof body ? sizeof body : n;
    for (size_t k = 0; k < n; k++) {
        body[k] = read_u8();
    }
    uint8_t seq = (uint8_t)(o->next_seq + (how & 32 ? read_u8() : 0));
    send_frame_as(type % 32 + (how & 128), seq, how & 64 ? read_u16() : o->session, body, n);
}

/* Sends an effective frame with one flipped bit, which must have no effect. */
static void send_damaged_frame(void) {
    static const uint8_t TYPES[] = {0x13, 0x16, 0x19, 0x01, 0x17};
    uint8_t wire[REFERENCE_WIRE_MAX], body[6] = {1}, type = TYPES[read_u8() % COUNT(TYPES)], where = read_u8();
    size_t n = reference_encode(wire, type, o->next_seq, o->session, body, type == 0x01 ? 6 : 0);
    size_t at = (where >> 3) % (n - 1);
    wire[at] ^= (uint8_t)(1u << (where & 7));
    o->pending_type = 0;
    if (wire[at]) { /* else the frame is split in two */
        send_bytes(wire, n, true);
    }
}

static void send_junk(void) {
    uint8_t bytes[64], n = read_u8() % sizeof bytes;
    for (size_t k = 0; k < n; k++) {
        bytes[k] = read_u8();
    }
    bytes[n] = 0;
    o->pending_type = 0;
    send_bytes(bytes, (size_t)n + 1, true);
}

static void arm(void) {
    arm_request();
    if (read_u8() & 1) {
        arm_confirm(o->host_nonce, read_u8() & 1 ? o->board_nonce : read_u8());
    }
}

/* Arms as a correct host does. */
static void arm_fully(void) {
    hello(1);
    send_frame(0x17, NULL, 0);
    arm_request();
    arm_confirm(o->host_nonce, o->board_nonce);
    for (unsigned n = 0; n < 41; n++) {
        lease(65535);
        wait(50000, true);
    }
}

static void change_input(void) {
    uint8_t which = read_u8(), input = (uint8_t)(1u << which % (board->config.interface == INTERFACE_XY2_100 ? 4 : 3));
    oracle_inputs_change(o, o->inputs ^ input);
    tick();
    if (which & 8) { /* a short change */
        oracle_inputs_change(o, o->inputs ^ input);
        tick();
    }
}

static void stick_readback(void) {
    uint8_t how = read_u8();
    driver.stuck = how & 1;
    driver.stuck_on = how & 2;
}

static void link_lost(void) {
    board_on_link_lost(board, o->now_us);
    oracle_check(o, board);
    if (o->gate_on || (o->state != STATE_FAULT && o->state != STATE_DISARMED)) {
        report_violation("ABORT", "goes on after the link was lost");
    }
}

static void abort_frame(void) {
    send_frame_as(0x13, read_u8(), read_u8() & 1 ? o->session : read_u16(), NULL, 0);
    if (o->gate_on || (o->state != STATE_FAULT && o->state != STATE_DISARMED)) {
        report_violation("ABORT", "goes on after ABORT");
    }
}

static void step(const struct board_config *config) {
    static const uint32_t WAITS_US[] = {1000, 1, 100, 450, 5000, 20000, 60000, 110000};
    static const uint16_t LATE_US[] = {150, 300, 600, 601, 1000, 5000};
    static const uint16_t LEASES_MS[] = {65535, 100, 10, 1};
    uint8_t what = read_u8();
    uint8_t detail = what / 24;
    switch (what % 24) {
    case 0: case 1: case 2:
        wait(WAITS_US[detail % COUNT(WAITS_US)], true);
        break;
    case 3: case 4: case 5:
        play();
        break;
    case 6:
        data(o->next_index + (detail == 9 ? 5 : detail == 8 ? ~0u : 0), detail % 4 + 1u);
        break;
    case 7:
        start(o->queue_count ? o->queue[o->queue_first % POINTS_MAX].index : o->next_index, detail & 1 ? read_u16() : 0,
              detail >> 1);
        break;
    case 8:
        end(o->next_index);
        break;
    case 9:
        lease(LEASES_MS[detail % COUNT(LEASES_MS)]);
        break;
    case 10:
        send_frame(0x19, NULL, 0);
        break;
    case 11:
        change_input();
        break;
    case 12:
        send_frame(detail & 1 ? 0x16 : 0x17, NULL, 0);
        break;
    case 13:
        if (detail < 8) {
            arm();
        } else {
            arm_fully();
        }
        break;
    case 14:
        hello(detail != 1);
        break;
    case 15:
        limits();
        break;
    case 16:
        send_random_frame();
        break;
    case 17:
        send_damaged_frame();
        break;
    case 18:
        send_junk();
        break;
    case 19:
        late_tick(LATE_US[detail % COUNT(LATE_US)]);
        break;
    case 20:
        stick_readback();
        break;
    case 21:
        wait(WAITS_US[detail % COUNT(WAITS_US)], false);
        break;
    case 22:
        if (detail & 1) {
            link_lost();
        } else {
            abort_frame();
        }
        break;
    default:
        if (detail == 0) {
            power_up(config);
        } else if (detail & 1) {
            send_frame(0x18, NULL, 0);
        } else if (detail == 2) {
            start_on_trigger(read_u8());
        } else if (detail == 4) {
            driver.trigger_us = o->now_us;
            driver.triggers++;
            tick();
        } else if (detail == 6) {
            send_frame(0x1c, NULL, 0);
        } else {
            wait(2100000, true);
        }
        break;
    }
}

/* --- armed boards --- */

static void begin(const struct board_config *config) {
    memset(&driver, 0, sizeof driver);
    o->inputs = INPUT_INTERLOCK | INPUT_KEY | HEAD_READY;
    o->x = o->y = 32768;
    o->now_us = 1000;
    power_up(config);
}

/* Key off at power-up, then on, which is no fault. */
static void turn_key(const struct board_config *config) {
    oracle_inputs_change(o, INPUT_INTERLOCK | HEAD_READY);
    power_up(config);
    oracle_inputs_change(o, INPUT_INTERLOCK | INPUT_KEY | HEAD_READY);
    wait(200, true);
}

int LLVMFuzzerInitialize(int *argc, char ***argv) {
    (void)argc, (void)argv;
    for (size_t k = 0; k < BOARDS; k++) {
        board = armed_boards[k] = malloc(sizeof *board);
        begin(&BOARDS_LIMITS[k]);
        if (BOARDS_LIMITS[k].key_edge) {
            turn_key(&BOARDS_LIMITS[k]);
        }
        arm_fully();
        if (o->state != STATE_ARMED) {
            report_violation("driver", "the board does not arm");
        }
        driver.ticks = 0;
        armed_drivers[k] = driver;
    }
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
    input = bytes;
    input_end = bytes + n;
    uint8_t which = read_u8();
    const struct board_config *config = &BOARDS_LIMITS[which % BOARDS];
    board = malloc(sizeof *board);
    if (which & 128) {
        begin(config);
    } else {
        driver = armed_drivers[which % BOARDS];
        memcpy(board, armed_boards[which % BOARDS], sizeof *board);
    }
    for (unsigned k = 0; k < STEPS_MAX && input < input_end && driver.ticks < TICKS_MAX; k++) {
        step(config);
    }
    wait(120000, true);
    free(board);
    return 0;
}
