/* The core between a pty and the system clock.

   Linux does not schedule a process every 100 µs. Each iteration therefore runs all ticks since the last one, each with
   its nominal time, before it reads the port. The core sees punctual ticks; only a script makes one late. */

#define _GNU_SOURCE

#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "host.h"

#define LOOP_WAIT_MAX_US 5000u
#define CLOSED_WAIT_US 1000u
#define PACED_WAIT_US 500u
#define WATCHDOG_US 50000u
#define LATE_TICK_US 1000u
#define TIMER_SLACK_NS 1000ul
#define HEAD_OK 0xfdfdu    /* power, temperature, positions */
#define HEAD_POWER 0x8080u
#define MIRROR_SLOW_US 20000u
#define DISCONNECTED_CODE 72000 /* of an input that its pull-up holds beyond the range of positions */

static volatile sig_atomic_t stopped, signals;

static void on_signal(int number) {
    (void)number;
    stopped = 1;
}

static void on_step_signal(int number) {
    (void)number;
    signals++;
}

static uint64_t clock_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static uint64_t now_us(const struct port *port) { return (clock_ns() - port->started_ns) / 1000u; }

/* --- the HAL --- */

static void set_gate(void *context, bool on, uint16_t duty) {
    (void)duty;
    ((struct port *)context)->gate_on = on;
}
static bool read_gate(void *context) {
    const struct port *port = context;
    return port->readback_stuck ? port->readback_value : port->gate_on;
}
static void move_mirrors(void *context, uint16_t x, uint16_t y) {
    struct port *port = context;
    port->from_x = port->x;
    port->moved_us = port->at_us;
    port->x = x;
    port->y = y;
}
static uint16_t mirror_x(const struct port *port) {
    bool is_late = port->mirror_fault == STEP_SLOW_MIRROR && port->at_us < port->moved_us + MIRROR_SLOW_US;
    return port->mirror_fault == STEP_STICK_MIRROR ? port->stuck_x : is_late ? port->from_x : port->x;
}
static void read_position(void *context, int32_t *x, int32_t *y) {
    const struct port *port = context;
    *x = port->mirror_fault == STEP_UNPLUG_MIRROR ? DISCONNECTED_CODE : mirror_x(port);
    *y = port->y;
}
static void ignore_output(void *context, bool on) { (void)context, (void)on; }
static uint8_t read_inputs(void *context) { return ((struct port *)context)->inputs; }
static bool read_head(void *context, uint16_t *status) {
    const struct port *port = context;
    *status = port->head;
    return port->head != 0;
}
static uint32_t read_triggers(void *context, uint64_t *last_us) {
    const struct port *port = context;
    *last_us = port->trigger_us;
    return port->triggers;
}
static int16_t read_temperature_dc(void *context) {
    (void)context;
    return 250;
}
static uint32_t read_entropy(void *context) {
    uint32_t value = 0;
    (void)context;
    while (getrandom(&value, sizeof value, 0) != sizeof value) {
    }
    return value;
}
static void send(void *context, const uint8_t *frame, size_t n) { line_send(&((struct port *)context)->line, frame, n); }
static void discard_output(void *context) { line_discard_output(&((struct port *)context)->line); }
static void feed_watchdog(void *context) {
    struct port *port = context;
    port->watchdog_fed_us = port->at_us;
}
static void trace(void *context, const struct board_trace *event) { log_trace(&((struct port *)context)->log, event); }

/* --- time --- */

static void reset(struct port *port, enum reset_cause cause) {
    if (port->gate_on) {
        log_trace(&port->log, &(struct board_trace){.at_us = port->at_us, .kind = TRACE_GATE});
    }
    board_init(&port->board, &port->hal, &port->config, cause, port->at_us);
    port->watchdog_fed_us = port->at_us;
    port->loop_stopped = port->tick_stopped = false;
}

static void tick(struct port *port) {
    if (!port->tick_stopped) {
        board_tick(&port->board, port->at_us);
    }
    if (!port->loop_stopped) {
        board_receive(&port->board, NULL, 0, port->at_us);
    }
    if (port->at_us - port->watchdog_fed_us > WATCHDOG_US) {
        reset(port, RESET_WATCHDOG);
    }
}

/* Runs all ticks up to until_us. */
static void run_ticks_until(struct port *port, uint64_t until_us) {
    while (port->at_us < until_us) {
        uint64_t next_us = port->at_us + BOARD_TICK_US;
        if (next_us < port->ticks_resume_us) {
            next_us = port->ticks_resume_us;
        }
        if (next_us > until_us && until_us < port->ticks_resume_us) {
            return;
        }
        port->at_us = next_us < until_us ? next_us : until_us;
        tick(port);
    }
}

/* --- script --- */

static void on_port_closed(struct port *port) {
    log_port(&port->log, port->at_us, false);
    board_on_link_lost(&port->board, port->at_us);
    port->line.closed_since_us = port->at_us;
    port->line.open = false;
}

static void set_input(struct port *port, const struct step *step) {
    port->inputs = (uint8_t)(step->value ? port->inputs | step->input : port->inputs & ~step->input);
    log_input(&port->log, port->at_us, input_name(step->input), step->value);
    board_tick(&port->board, port->at_us);
}

static void run_step(struct port *port, const struct step *step) {
    switch (step->kind) {
    case STEP_SET:
        set_input(port, step);
        break;
    case STEP_FLIP_BITS:
        port->line.flip_rate = step->rate;
        break;
    case STEP_DROP_BYTES:
        port->line.drop_rate = step->rate;
        break;
    case STEP_HANG:
        port->line.hung = true;
        break;
    case STEP_REPAIR:
        port->line.drop_rate = port->line.flip_rate = 0;
        port->line.hung = port->readback_stuck = false;
        port->head = HEAD_OK;
        port->mirror_fault = STEP_SET;
        break;
    case STEP_RESET:
        port->line.output_count = 0;
        reset(port, RESET_RESET);
        break;
    case STEP_CLOSE:
        on_port_closed(port);
        line_close(&port->line);
        stopped = !line_open(&port->line);
        break;
    case STEP_STOP_LOOP:
        port->loop_stopped = true;
        break;
    case STEP_STOP_TICK:
        port->tick_stopped = true;
        break;
    case STEP_LATE_TICK:
        port->ticks_resume_us = port->at_us + LATE_TICK_US;
        break;
    case STEP_TRIGGER:
        log_trigger(&port->log, port->at_us, ++port->triggers);
        port->trigger_us = port->at_us;
        break;
    case STEP_SILENCE_HEAD:
        port->head = 0;
        break;
    case STEP_FAIL_HEAD:
        port->head = HEAD_OK & ~HEAD_POWER;
        break;
    case STEP_STICK_MIRROR:
    case STEP_SLOW_MIRROR:
    case STEP_UNPLUG_MIRROR:
        port->stuck_x = port->from_x = mirror_x(port); /* slow from the next move on */
        port->mirror_fault = step->kind;
        break;
    case STEP_STICK_GATE:
        port->readback_value = port->gate_on;
        port->readback_stuck = true;
        break;
    }
}

static void run_due_steps(struct port *port) {
    struct script *script = &port->script;
    while (script->next < script->count && script->steps[script->next].at_us <= now_us(port)) {
        const struct step *step = &script->steps[script->next++];
        run_ticks_until(port, step->at_us);
        run_step(port, step);
    }
    for (; script->signals_seen != (int)signals; script->signals_seen++) {
        if (script->signalled_next < script->signalled_count) {
            run_ticks_until(port, now_us(port));
            run_step(port, &script->signalled[script->signalled_next++]);
        }
    }
}

/* --- one iteration --- */

static void receive(struct port *port, bool last) {
    uint8_t bytes[READ_MAX];
    size_t n;
    while ((n = line_read(&port->line, bytes, port->at_us, last)) > 0) {
        run_ticks_until(port, now_us(port)); /* or a reply to CLOCK could tell a time before its request was sent */
        uint64_t until_us = port->board.lease_until_us;
        board_receive(&port->board, bytes, n, port->at_us);
        if (port->board.lease_until_us > until_us) {
            log_lease(&port->log, port->at_us, port->board.lease_until_us);
        }
        if (!last) {
            return;
        }
    }
}

/* Bytes that a host wrote before it closed are processed first, so that they do not affect a later host. */
static void update_line_state(struct port *port) {
    struct line *line = &port->line;
    bool hung_up = line_hung_up(line);
    if (line->open && hung_up) {
        receive(port, true);
        on_port_closed(port);
    } else if (!line->open && !hung_up) {
        log_port(&port->log, port->at_us, true);
        line->was_open = true;
    }
    line->open = !hung_up;
    if (line->was_open && hung_up && port->exit_when_closed_us != UINT64_MAX &&
        port->at_us - line->closed_since_us > port->exit_when_closed_us) {
        stopped = 1;
    }
}

static uint64_t min_wait_us(uint64_t wait_us, uint64_t due_us, uint64_t now) {
    uint64_t left_us = due_us > now ? due_us - now : 0;
    return left_us < wait_us ? left_us : wait_us;
}

static void wait(struct port *port) {
    const struct script *script = &port->script;
    uint64_t now = now_us(port), wait_us = min_wait_us(LOOP_WAIT_MAX_US, board_next_due_us(&port->board), now);
    struct pollfd look = {.fd = port->line.master, .events = POLLIN};
    if (script->next < script->count) {
        wait_us = min_wait_us(wait_us, script->steps[script->next].at_us, now);
    }
    nfds_t count = 1;
    if (!port->line.open) {
        count = 0;
        wait_us = wait_us > CLOSED_WAIT_US ? wait_us : CLOSED_WAIT_US;
    } else if (!line_can_read(&port->line, now) || port->loop_stopped) {
        count = 0;
        wait_us = wait_us < PACED_WAIT_US ? wait_us : PACED_WAIT_US;
    } else if (port->line.output_count > 0) {
        wait_us = wait_us < PACED_WAIT_US ? wait_us : PACED_WAIT_US;
    }
    struct timespec span = {.tv_nsec = (long)wait_us * 1000};
    ppoll(&look, count, &span, NULL);
}

static void run_once(struct port *port) {
    run_due_steps(port);
    run_ticks_until(port, now_us(port));
    bool serving = !port->loop_stopped && port->at_us >= port->ticks_resume_us;
    if (serving) {
        update_line_state(port);
    }
    if (!port->line.open) {
        port->line.output_count = 0;
    } else if (serving) {
        receive(port, false);
        line_write(&port->line, port->at_us);
    }
    wait(port);
}

void port_run(struct port *port) {
    port->hal = (struct board_hal){
        .context = port,
        .set_gate = set_gate,
        .read_gate = read_gate,
        .move_mirrors = move_mirrors,
        .read_inputs = read_inputs,
        .read_head = read_head,
        .read_position = read_position,
        .read_triggers = read_triggers,
        .set_indicator = ignore_output,
        .set_relay = ignore_output,
        .read_entropy = read_entropy,
        .read_temperature_dc = read_temperature_dc,
        .send = send,
        .discard_output = discard_output,
        .feed_watchdog = feed_watchdog,
        .trace = trace,
    };
    signal(SIGTERM, on_signal);
    signal(SIGINT, on_signal);
    signal(SIGUSR1, on_step_signal);
    prctl(PR_SET_TIMERSLACK, TIMER_SLACK_NS);
    port->inputs = INPUT_INTERLOCK | INPUT_KEY;
    port->head = HEAD_OK;
    port->started_ns = clock_ns();
    board_init(&port->board, &port->hal, &port->config, RESET_POWER_UP, 0);
    while (!stopped && !port->log.failed) {
        run_once(port);
    }
    board_on_link_lost(&port->board, port->at_us);
    unlink(port->line.path);
}
