/* Guards B4 to B6 and B8: checks of a point when queued, and of its pulse before the gate opens. Integers only. */

#include "core.h"

#define DUTY_FULL 65535u
#define MOVES_US 1000000000u
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

/* Time since the last pulse of the cell began. */
static uint32_t age_us(const struct cell *cell, uint64_t now_us) { return (uint32_t)now_us - cell->since_us; }

/* B4: gate-on time of the cell since its last rest. */
static uint32_t on_time_us(const struct cell *cell, const struct board_limits *limits, uint64_t now_us) {
    return age_us(cell, now_us) >= (uint32_t)cell->last_on_us + limits->rest_us ? 0 : cell->on_us;
}

static uint64_t leaked_uj(const struct board_limits *limits, uint32_t us) {
    return (uint64_t)us * limits->spot_leak_uw / 1000000u; /* two words fit 64 bits */
}

/* B6: level of the bucket. */
static uint32_t level_uj(const struct cell *cell, const struct board_limits *limits, uint64_t now_us) {
    if (cell->level_uj == 0) {
        return 0;
    }
    uint64_t leaked = leaked_uj(limits, age_us(cell, now_us));
    return leaked >= cell->level_uj ? 0 : (uint32_t)(cell->level_uj - leaked);
}

static uint16_t *bucket_of(struct grid *grid, uint32_t key) {
    uint32_t hash = key * 2654435761u;
    return &grid->buckets[(hash ^ hash >> 15) % BOARD_BUCKETS];
}

/* Takes a place that is free, or 0 if capacity places are in use. */
static uint16_t take_place(struct grid *grid, uint16_t capacity) {
    if (grid->count == capacity) {
        return 0;
    }
    uint16_t place = grid->free;
    if (place) {
        grid->free = grid->cells[place - 1].next;
    } else {
        place = ++grid->touched;
    }
    grid->count++;
    return place;
}

/* Returns the account of a cell, a new one if it has none; NULL if all are in use. */
static struct cell *find_account(struct grid *grid, uint32_t key, uint16_t capacity, uint64_t now_us) {
    uint16_t *bucket = bucket_of(grid, key);
    for (uint16_t place = *bucket; place; place = grid->cells[place - 1].next) {
        if (grid->cells[place - 1].key == key) {
            return &grid->cells[place - 1];
        }
    }
    uint16_t place = take_place(grid, capacity);
    if (!place) {
        return NULL;
    }
    struct cell *cell = &grid->cells[place - 1];
    *cell = (struct cell){.key = key, .used = true, .next = *bucket, .since_us = (uint32_t)now_us};
    *bucket = place;
    return cell;
}

static void give_back(struct grid *grid, uint16_t place) {
    struct cell *cell = &grid->cells[place - 1];
    uint16_t *link = bucket_of(grid, cell->key);
    while (*link != place) {
        link = &grid->cells[*link - 1].next;
    }
    *link = cell->next;
    cell->used = false;
    cell->next = grid->free;
    grid->free = place;
    grid->count--;
}

/* An old cell's time moves on by whole seconds, in which its bucket leaks whole microjoules. */
static void sweep(struct grid *grid, const struct board_limits *limits, uint16_t capacity, uint64_t now_us) {
    grid->swept = grid->swept < grid->touched ? (uint16_t)(grid->swept + 1) : 1;
    struct cell *cell = &grid->cells[grid->swept - 1];
    if (!grid->touched || !cell->used) {
        return;
    }
    bool is_cold = on_time_us(cell, limits, now_us) == 0 && level_uj(cell, limits, now_us) == 0;
    if (is_cold && grid->count > capacity / 2) {
        give_back(grid, grid->swept);
    } else if (age_us(cell, now_us) > MOVES_US) {
        cell->level_uj = is_cold ? 0 : (uint32_t)(cell->level_uj - leaked_uj(limits, MOVES_US));
        cell->since_us += MOVES_US;
        cell->on_us = 0; /* it has rested */
    }
}

/* --- B5 --- */

static const struct pulse *pulse_at(const struct guards *g, uint32_t k) {
    return &g->pulses[(g->first + k) % BOARD_PULSES];
}

static uint64_t duty_us(const struct pulse *pulse) { return (uint64_t)pulse->on_us * pulse->duty; }

/* Time from the begin of the pulse to a later time. */
static uint32_t since_us(const struct pulse *pulse, uint64_t later_us) { return (uint32_t)later_us - pulse->start_us; }

static void drop_old_pulses(struct guards *g, uint64_t now_us) {
    while (g->count > 0 && since_us(pulse_at(g, 0), now_us) >= pulse_at(g, 0)->on_us + MEAN_WINDOW_US) {
        g->sum -= duty_us(pulse_at(g, 0));
        g->first = (g->first + 1) % BOARD_PULSES;
        g->count--;
    }
}

/* Sum of on time × duty of older pulses in the second that ends at end_us. expired, expired_duty_us: pulses that lie
   entirely before it, kept from one call to the next. */
static uint64_t window_duty_us(const struct guards *g, uint64_t end_us, uint32_t *expired, uint64_t *expired_duty_us) {
    while (*expired < g->count && since_us(pulse_at(g, *expired), end_us) >= pulse_at(g, *expired)->on_us + MEAN_WINDOW_US) {
        *expired_duty_us += duty_us(pulse_at(g, (*expired)++));
    }
    uint64_t outside = *expired_duty_us;
    for (uint32_t k = *expired; k < g->count && since_us(pulse_at(g, k), end_us) > MEAN_WINDOW_US; k++) {
        uint32_t out_us = since_us(pulse_at(g, k), end_us) - MEAN_WINDOW_US;
        outside += (uint64_t)(out_us < pulse_at(g, k)->on_us ? out_us : pulse_at(g, k)->on_us) * pulse_at(g, k)->duty;
    }
    return g->sum - outside;
}

/* Maximum sum of on time × duty over any second that contains this pulse, µs × duty. The sum peaks where the pulse
   ends or where an older pulse begins to leave the window, so only those windows are evaluated. */
static uint64_t max_window_duty_us(const struct guards *g, const struct point *point, uint64_t now_us) {
    uint64_t end_us = now_us + point->on_us, max_duty_us = 0, expired_duty_us = 0;
    uint32_t expired = 0;
    for (uint32_t k = 0; k < g->count; k++) {
        uint32_t age = since_us(pulse_at(g, k), now_us);
        if (age + point->on_us <= MEAN_WINDOW_US) {
            break;
        }
        if (age < MEAN_WINDOW_US) {
            uint32_t after_us = MEAN_WINDOW_US - age; /* from now until the pulse begins to leave */
            uint64_t sum = window_duty_us(g, now_us + after_us, &expired, &expired_duty_us) + (uint64_t)after_us * point->duty;
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

/* Finds the accounts of the four cells of a point; returns false if a grid has none left. */
static bool find_accounts(struct guards *g, const struct board_config *config, const struct point *point, uint64_t now_us,
                          struct cell *cells[GRIDS]) {
    uint16_t size = config->cell_codes, half = size / 2;
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        uint32_t column = cell_index(point->x, grid & 1 ? 0 : half, size);
        uint32_t row = cell_index(point->y, grid & 2 ? 0 : half, size);
        cells[grid] = find_account(&g->grids[grid], column | row << 16, config->cells, now_us);
        if (!cells[grid]) {
            return false;
        }
    }
    return true;
}

/* The accounts of a point's four cells before its pulse, and the pulse's energy: each costs a chip a division. */
struct accounts {
    uint32_t on_us[GRIDS], level_uj[GRIDS];
    uint64_t energy_uj;
};

static struct accounts read_accounts(const struct board_limits *limits, struct cell *const cells[GRIDS],
                                     const struct point *point, uint64_t now_us) {
    struct accounts accounts = {.energy_uj = energy_uj(limits, point)};
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        accounts.on_us[grid] = on_time_us(cells[grid], limits, now_us);
        accounts.level_uj[grid] = level_uj(cells[grid], limits, now_us);
    }
    return accounts;
}

static enum fault check_pulse(const struct guards *g, const struct board_limits *limits, const struct accounts *accounts,
                              const struct point *point, uint64_t now_us) {
    uint32_t on_us = 0, level = 0;
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        on_us = accounts->on_us[grid] > on_us ? accounts->on_us[grid] : on_us;
        level = accounts->level_uj[grid] > level ? accounts->level_uj[grid] : level;
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
    return level + accounts->energy_uj > limits->spot_uj ? FAULT_SPOT : FAULT_NONE;
}

enum fault guards_accept_pulse(struct guards *g, const struct board_limits *limits, const struct board_config *config,
                               const struct point *point, uint64_t now_us) {
    struct cell *cells[GRIDS];
    drop_old_pulses(g, now_us);
    if (!find_accounts(g, config, point, now_us, cells)) {
        return FAULT_CELLS;
    }
    struct accounts accounts = read_accounts(limits, cells, point, now_us);
    enum fault fault = check_pulse(g, limits, &accounts, point, now_us);
    if (fault != FAULT_NONE || g->count == config->window_pulses) {
        return fault != FAULT_NONE ? fault : FAULT_PULSES;
    }
    for (uint32_t grid = 0; grid < GRIDS; grid++) {
        struct cell *cell = cells[grid];
        cell->on_us = (uint16_t)(accounts.on_us[grid] + point->on_us); /* at most max_on_us */
        cell->level_uj = (uint32_t)(accounts.level_uj[grid] + accounts.energy_uj);
        cell->last_on_us = point->on_us;
        cell->since_us = (uint32_t)now_us;
    }
    g->pulses[(g->first + g->count++) % BOARD_PULSES] = (struct pulse){(uint32_t)now_us, point->on_us, point->duty};
    g->sum += (uint64_t)point->on_us * point->duty;
    return FAULT_NONE;
}

void guards_tick(struct guards *g, const struct board_limits *limits, const struct board_config *config, uint64_t now_us) {
    drop_old_pulses(g, now_us);
    sweep(&g->grids[g->turn++ % GRIDS], limits, config->cells, now_us);
}
