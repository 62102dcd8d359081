/* Queue of points, and ring of execution records. */

#include "core.h"

bool queue_push(struct queue *q, const struct point *point) {
    if (q->count == BOARD_QUEUE_POINTS) {
        return false;
    }
    q->points[(q->first + q->count++) % BOARD_QUEUE_POINTS] = *point;
    return true;
}

struct point queue_pop(struct queue *q) {
    struct point point = q->points[q->first];
    q->first = (q->first + 1) % BOARD_QUEUE_POINTS;
    q->count--;
    return point;
}

void records_clear(struct records *r) { r->total = r->reported = 0; }

void records_add(struct records *r, const struct record *record) { r->ring[r->total++ % BOARD_RECORDS] = *record; }

uint32_t records_oldest(const struct records *r) { return r->total > BOARD_RECORDS ? r->total - BOARD_RECORDS : 0; }

static const struct record *record_at(const struct records *r, uint32_t at) { return &r->ring[at % BOARD_RECORDS]; }

uint32_t records_find(const struct records *r, uint32_t number) {
    uint32_t low = records_oldest(r), high = r->total;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        if (record_at(r, middle)->number < number) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    return low;
}

size_t records_report(const struct records *r, uint32_t at, uint8_t *body, size_t *length) {
    if (at >= r->total) {
        return 0;
    }
    const struct record *first = record_at(r, at);
    uint8_t *to = body + EXECUTED_SIZE;
    size_t count = 0;
    for (; count < EXECUTED_ITEMS_MAX && at + count < r->total; count++, to += RECORD_SIZE) {
        const struct record *record = record_at(r, at + (uint32_t)count);
        uint64_t offset = record->on_tick - first->on_tick;
        if (record->number != first->number + count || offset > UINT32_MAX) {
            break;
        }
        put_u32(to + RECORD_OFFSET_AT, (uint32_t)offset);
        put_u16(to + RECORD_ON_TICKS_AT, record->on_ticks);
        put_u16(to + RECORD_DUTY_AT, record->duty);
    }
    put_u32(body + EXECUTED_FIRST_INDEX_AT, first->number);
    put_u64(body + EXECUTED_BASE_TICK_AT, first->on_tick);
    *length = (size_t)(to - body);
    return count;
}
