/* Independent checks of B4 to B6, in floating point over the list of all pulses. */

#include <math.h>

#include "oracle.h"

#define FULL 65535.0
#define SECOND_US 1000000.0

static int cell(uint16_t code, uint16_t cell_codes, bool shifted) {
    return (int)floor(((double)code - 32768.0 + (shifted ? cell_codes / 2 : 0)) / cell_codes);
}

static bool same_cell(const struct oracle *o, const struct observed_pulse *a, const struct observed_pulse *b, unsigned grid) {
    bool in_x = grid & 1, in_y = grid & 2;
    return cell(a->x, o->cell_codes, in_x) == cell(b->x, o->cell_codes, in_x) &&
           cell(a->y, o->cell_codes, in_y) == cell(b->y, o->cell_codes, in_y);
}

static const struct observed_pulse *find_previous(const struct oracle *o, const struct observed_pulse *pulse, unsigned grid) {
    for (const struct observed_pulse *old = pulse; old-- > o->pulses;) {
        if (same_cell(o, old, pulse, grid)) {
            return old;
        }
    }
    return NULL;
}

static void check_cell(const struct oracle *o, struct observed_pulse *pulse, unsigned grid) {
    const struct observed_pulse *old = find_previous(o, pulse, grid);
    double energy_uj = (double)pulse->on_us * pulse->duty / FULL * o->limits.full_power_uw * 1e-6, level_uj = 0;
    pulse->account_us[grid] = pulse->on_us;
    if (old) {
        bool rested = pulse->from_us + o->late_us >= old->from_us + old->on_us + o->limits.rest_us;
        pulse->account_us[grid] += rested ? 0 : old->account_us[grid];
        double age_us = (double)(pulse->from_us - old->from_us + o->late_us);
        level_uj = fmax(0, old->level_uj[grid] - age_us * 1e-6 * o->limits.spot_leak_uw);
    }
    pulse->level_uj[grid] = level_uj + energy_uj;
    if (pulse->account_us[grid] > o->limits.max_on_us) {
        report_violation("B4", "a cell is lit for too long");
    }
    if (pulse->level_uj[grid] > o->limits.spot_uj + 1e-6) {
        report_violation("B6", "a cell's bucket runs over");
    }
}

/* On time × duty within the second that ends at end_us, µs; the newest pulse counts with its full width. */
static double window_duty_us(const struct oracle *o, double end_us) {
    double sum = 0;
    for (uint32_t k = 0; k < o->pulses_count; k++) {
        const struct observed_pulse *pulse = &o->pulses[k];
        double from_us = (double)pulse->from_us, to_us = from_us + pulse->on_us;
        to_us = pulse->to_us ? fmin(to_us, (double)pulse->to_us) : to_us;
        sum += pulse->duty * fmax(0, fmin(to_us, end_us) - fmax(from_us, end_us - SECOND_US));
    }
    return sum;
}

static void check_mean_power(const struct oracle *o, const struct observed_pulse *pulse) {
    double limit = SECOND_US * o->limits.mean_duty + (double)o->late_us * FULL + 0.5;
    double begin_us = (double)pulse->from_us, end_us = begin_us + pulse->on_us, max_duty_us = window_duty_us(o, end_us);
    for (uint32_t k = 0; k < o->pulses_count; k++) { /* the sum peaks only where a pulse begins to leave the second */
        double leaves_us = (double)o->pulses[k].from_us + SECOND_US;
        if (leaves_us > begin_us && leaves_us < end_us) {
            max_duty_us = fmax(max_duty_us, window_duty_us(o, leaves_us));
        }
    }
    if (max_duty_us > limit) {
        report_violation("B5", "a second holds too much light");
    }
}

struct observed_pulse *check_pulse_power(struct oracle *o) {
    if (o->pulses_count == POINTS_MAX) {
        report_violation("driver", "more pulses than it may ask for");
    }
    struct observed_pulse *pulse = &o->pulses[o->pulses_count++];
    *pulse = (struct observed_pulse){.from_us = o->now_us, .index = o->current.index, .x = o->current.x, .y = o->current.y,
                                 .on_us = o->current.on_us, .duty = o->current.duty};
    for (unsigned grid = 0; grid < 4; grid++) {
        check_cell(o, pulse, grid);
    }
    check_mean_power(o, pulse);
    return pulse;
}
