/* Guards B4 to B6 and B8: checks of a point when queued, and of its pulse before the gate opens. Integers only. */

#include "core.h"

#define DUTY_FULL 65535u
#define PROBES_MAX 32u
#define GRIDS 4u

enum fault guards_check_point(const struct board_limits *limits, const struct point *point) {
#if MUTANT != 8
    if (point->x < limits->x_min || point->x > limits->x_max || point->y < limits->y_min || point->y > limits->y_max) {
        return FAULT_RANGE;
    }
#endif
    if (point->on_us > limits->max_on_us) {
        return FAULT_ON_TIME;
    }
    return point->duty > limits->max_duty ? FAULT_DUTY : FAULT_NONE;
}

/* --- cells --- */

static uint16_t cell_index(uint16_t code, uint16_t shift, uint16_t size) {
    int32_t from_centre = (int32_t)code - (int32_t)CENTRE + shift;
    int32_t cell = from_centre / size;
    if (from_centre < 0 && from_centre % size != 0) {
        cell--;
    }
    return (uint16_t)cell; /* a grid has at most 65,536 cells per axis, so the indices stay distinct */
}

/* B4: gate-on time of the cell since its last rest. */
static uint32_t on_time_us(const struct cell *cell, const struct board_limits *limits, uint64_t now_us) {
    bool rested = now_us >= cell->ended_us && now_us - cell->ended_us >= limits->rest_us;
    return rested ? 0 : cell->on_us;
}

/* B6: level of the bucket. Whole seconds and remainder are computed separately to avoid an overflow. */
static uint32_t level_uj(const struct cell *cell, const struct board_limits *limits, uint64_t now_us) {
    uint64_t age_us = now_us - cell->since_us, leak = limits->spot_leak_uw;
    if (age_us / 1000000u > UINT32_MAX) {
        return leak ? 0 : cell->level_uj;
    }
    uint64_t leaked = age_us / 1000000u * leak + age_us % 1000000u * leak / 1000000u;
    return leaked >= cell->level_uj ? 0 : (uint32_t)(cell->level_uj - leaked);
}

/* Returns the account of a cell. A rested cell with an empty bucket is replaced; NULL if no slot is free. */
static struct cell *find_account(struct cell *cells, uint32_t key, const struct board_limits *limits, uint64_t now_us) {
    struct cell *free_slot = NULL;
    uint32_t hash = key * 2654435761u;
    hash ^= hash >> 15;
    for (uint32_t k = 0; k < PROBES_MAX; k++) {
        struct cell *cell = &cells[(hash + k) % BOARD_CELLS];
        if (cell->used && cell->key == key) {
            return cell;
        }
        if (!cell->used) {
            free_slot = free_slot ? free_slot : cell;
            break; /* slots are never emptied, so the key is in none of the following ones */
        }
        if (!free_slot && on_time_us(cell, limits, now_us) == 0 && level_uj(cell, limits, now_us) == 0) {
            free_slot = cell;
        }
    }
    if (free_slot) {
        *free_slot = (struct cell){.key = key, .used = true, .ended_us = now_us, .since_us = now_us};
    }
    return free_slot;
}

/* --- B5 --- */

static const struct pulse *pulse_at(const struct guards *g, uint32_t k) {
    return &g->pulses[(g->first + k) % BOARD_PULSES];
}

static uint64_t duty_us(const struct pulse *pulse) { return (uint64_t)pulse->on_us * pulse->duty; }

static void drop_old_pulses(struct guards *g, uint64_t now_us) {
    while (g->count > 0 && pulse_at(g, 0)->start_us + pulse_at(g, 0)->on_us + MEAN_WINDOW_US <= now_us) {
        g->sum -= duty_us(pulse_at(g, 0));
        g->first = (g->first + 1) % BOARD_PULSES;
        g->count--;
    }
}

/* Sum of on time × duty of older pulses in the second that ends at end_us. expired, expired_duty_us: pulses that lie
   entirely before it, kept from one call to the next. */
static uint64_t window_duty_us(const struct guards *g, uint64_t end_us, uint32_t *expired, uint64_t *expired_duty_us) {
    while (*expired < g->count &&
           pulse_at(g, *expired)->start_us + pulse_at(g, *expired)->on_us + MEAN_WINDOW_US <= end_us) {
        *expired_duty_us += duty_us(pulse_at(g, (*expired)++));
    }
    uint64_t outside = *expired_duty_us;
    for (uint32_t k = *expired; k < g->count && pulse_at(g, k)->start_us + MEAN_WINDOW_US < end_us; k++) {
        uint64_t out_us = end_us - MEAN_WINDOW_US - pulse_at(g, k)->start_us;
        outside += (out_us < pulse_at(g, k)->on_us ? out_us : pulse_at(g, k)->on_us) * pulse_at(g, k)->duty;
    }
    return g->sum - outside;
}

/* Maximum sum of on time × duty over any second that contains this pulse, µs × duty. The sum peaks where the pulse
   ends or where an older pulse begins to leave the window, so only those windows are evaluated. */
static uint64_t max_window_duty_us(const struct guards *g, const struct point *point, uint64_t now_us) {
    uint64_t end_us = now_us + point->on_us, max_duty_us = 0, expired_duty_us = 0;
    uint32_t expired = 0;
    for (uint32_t k = 0; k < g->count; k++) {
        uint64_t leaves_us = pulse_at(g, k)->start_us + MEAN_WINDOW_US;
        if (leaves_us >= end_us) {
            break;
        }
        if (leaves_us > now_us) {
            uint64_t sum = window_duty_us(g, leaves_us, &expired, &expired_duty_us) + (leaves_us - now_us) * point->duty;
            max_duty_us = sum > max_duty_us ? sum : max_duty_us;
        }
    }
    uint64_t sum = window_duty_us(g, end_us, &expired, &expired_duty_us) + (uint64_t)point->on_us * point->duty;
    return sum > max_duty_us ? sum : max_duty_us;
}

/* --- admission of a pulse --- */

/* Energy, µJ, rounded up; the product of the three maximum values fits 64 bits. */
static uint64_t energy_uj(const struct board_limits *limits, const struct point *point) {
    uint64_t product = (uint64_t)point->on_us * point->duty * limits->full_power_uw, full = DUTY_FULL * 1000000ull;
    return product / full + (product % full != 0);
}

/* Finds the accounts of the four cells of a point; returns false if a grid has no free slot. */
static bool find_accounts(struct guards *g, const struct board_limits *limits, uint16_t cell_codes,
                     const struct point *point, uint64_t now_us, struct cell *cells[GRIDS]) {
    uint16_t half = cell_codes / 2;
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        uint32_t column = cell_index(point->x, grid & 1 ? 0 : half, cell_codes);
        uint32_t row = cell_index(point->y, grid & 2 ? 0 : half, cell_codes);
        cells[grid] = find_account(g->cells[grid], column | row << 16, limits, now_us);
        if (!cells[grid]) {
            return false;
        }
    }
    return true;
}

static enum fault check_pulse(const struct guards *g, const struct board_limits *limits, struct cell *const cells[GRIDS],
                          const struct point *point, uint64_t now_us) {
    uint32_t on_us = 0, level = 0;
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        uint32_t had_us = on_time_us(cells[grid], limits, now_us), has_uj = level_uj(cells[grid], limits, now_us);
        on_us = had_us > on_us ? had_us : on_us;
        level = has_uj > level ? has_uj : level;
    }
#if MUTANT == 4
    on_us = 0;
#elif MUTANT == 6
    level = 0;
#endif
    if (on_us + point->on_us > limits->max_on_us) {
        return FAULT_ON_TIME;
    }
    if (MUTANT != 5 && max_window_duty_us(g, point, now_us) > (uint64_t)MEAN_WINDOW_US * limits->mean_duty) {
        return FAULT_MEAN_POWER;
    }
    return level + energy_uj(limits, point) > limits->spot_uj ? FAULT_SPOT : FAULT_NONE;
}

enum fault guards_accept_pulse(struct guards *g, const struct board_limits *limits, uint16_t cell_codes,
                       const struct point *point, uint64_t now_us) {
    struct cell *cells[GRIDS];
    drop_old_pulses(g, now_us);
    if (!find_accounts(g, limits, cell_codes, point, now_us, cells)) {
        return FAULT_SPOT;
    }
    enum fault fault = check_pulse(g, limits, cells, point, now_us);
    if (fault != FAULT_NONE || g->count == BOARD_PULSES) {
        return fault != FAULT_NONE ? fault : FAULT_MEAN_POWER;
    }
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        struct cell *cell = cells[grid];
        cell->on_us = on_time_us(cell, limits, now_us) + point->on_us;
        cell->ended_us = now_us + point->on_us;
        cell->level_uj = (uint32_t)(level_uj(cell, limits, now_us) + energy_uj(limits, point));
        cell->since_us = now_us;
    }
    g->pulses[(g->first + g->count++) % BOARD_PULSES] = (struct pulse){now_us, point->on_us, point->duty};
    g->sum += (uint64_t)point->on_us * point->duty;
    return FAULT_NONE;
}
