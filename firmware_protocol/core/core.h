/* Internal declarations of the core. */

#ifndef CORE_H
#define CORE_H

#include "board.h"

/* make MUTANT=n disables guard Bn at the one place that enforces it, to prove that the tests detect it; 101 and 102
   remove the bounds checks of the receiver, 103 both what enforces B12: sequence numbers and indices; 104 lets the main
   loop run through points while the tick is late (B14), 105 a pulse begin in the tick that sees an unsafe input (B9), and
   106 each agreement of the readback excuse the gate's other level (B14); 107 lets an edge before START_ON_TRIGGER start
   its job, 108 a job await its trigger without end, 109 delay_us count from the tick that noticed the edge, 110 each edge
   restart the delay; 111 lets a pulse begin beside its position, 112 only a pulse's begin looks at the mirrors (B17). */
#ifndef MUTANT
#define MUTANT 0
#endif

#define CENTRE 32768u
#define FRAME_OVERHEAD 8u                 /* header and CRC */
#define BODY_MAX (RAW_MAX - FRAME_OVERHEAD)
#define WIRE_MAX (RAW_MAX + 2u)           /* COBS code and delimiter */
#define NO_REFUSAL 0xffu                  /* instead of a NAK reason */

/* --- bytes --- */

static inline uint16_t get_u16(const uint8_t *at) { return (uint16_t)(at[0] | at[1] << 8); }
static inline uint32_t get_u32(const uint8_t *at) { return get_u16(at) | (uint32_t)get_u16(at + 2) << 16; }
static inline uint64_t get_u64(const uint8_t *at) { return get_u32(at) | (uint64_t)get_u32(at + 4) << 32; }

static inline void put_u16(uint8_t *at, uint16_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}
static inline void put_u32(uint8_t *at, uint32_t value) {
    put_u16(at, (uint16_t)value);
    put_u16(at + 2, (uint16_t)(value >> 16));
}
static inline void put_u64(uint8_t *at, uint64_t value) {
    put_u32(at, (uint32_t)value);
    put_u32(at + 4, (uint32_t)(value >> 32));
}

/* Not named crc32, which would resolve to zlib's function in a process that has zlib loaded. */
uint32_t frame_crc32(const uint8_t *bytes, size_t n);

/* Encodes at most RAW_MAX bytes; returns the number of bytes, at most n + 1, without a delimiter. */
size_t cobs_encode(uint8_t *encoded, const uint8_t *raw, size_t n);
/* Decodes in place; returns the number of bytes, 0 if they are not valid COBS of at most RAW_MAX bytes. */
size_t cobs_decode(uint8_t *bytes, size_t n);

/* --- link --- */

struct frame {
    const uint8_t *body;
    size_t length;
    uint16_t session;
    uint8_t type, seq;
};

enum frame_class { FRAME_NOT_ACCEPTED, FRAME_UNSEQUENCED, FRAME_SEQUENCED };

/* Processes one byte; returns true if it completes an intact frame, which stays valid until the next byte. */
bool receiver_feed(struct receiver *r, uint8_t byte, struct frame *frame);
/* Returns whether type, length and enumerations are those of a message; class: whether and how it is accepted. */
bool frame_is_valid(const struct frame *frame, enum frame_class *class);
/* Encodes a frame with its delimiter; returns the number of bytes. wire: buffer of WIRE_MAX bytes. */
size_t frame_encode(uint8_t *wire, uint8_t type, uint8_t seq, uint16_t session, const uint8_t *body, size_t n);
/* Returns whether a sequenced frame is the expected one; refusal: the answer if it is not. */
bool link_accept(struct link *link, uint8_t seq, uint8_t *refusal);
void link_mark_consumed(struct link *link, uint8_t refusal);
void link_begin(struct link *link, uint16_t session);

/* --- queue, records --- */

bool queue_push(struct queue *q, const struct point *point);
struct point queue_pop(struct queue *q);
void records_clear(struct records *r);
void records_add(struct records *r, const struct record *record);
/* Encodes one EXECUTED from position at on; returns the number of records, 0 if there are none. */
size_t records_report(const struct records *r, uint32_t at, uint8_t *body, size_t *length);
/* Returns the position of the first record with this number or a later one. */
uint32_t records_find(const struct records *r, uint32_t number);
uint32_t records_oldest(const struct records *r);

/* --- limits, guards --- */

void limits_decode(struct board_limits *limits, const uint8_t *from);
void limits_encode(const struct board_limits *limits, uint8_t *to);
void limits_tighten(struct board_limits *limits, const struct board_limits *requested);
/* B4, B5, B8: returns the fault that queueing the point causes, FAULT_NONE if it is permitted. */
enum fault guards_check_point(const struct board_limits *limits, const struct point *point);
/* B4 to B6: returns the fault that the point's pulse causes now; a permitted pulse is added to the accounts. */
enum fault guards_accept_pulse(struct guards *g, const struct board_limits *limits, const struct board_config *config,
                               const struct point *point, uint64_t now_us);
/* Forgets old pulses, and gives back the account of a cold cell of a grid that is more than half full, one at a time. */
void guards_tick(struct guards *g, const struct board_limits *limits, const struct board_config *config, uint64_t now_us);

/* --- states and points --- */

bool is_leased(uint8_t state);
/* B9: returns the fault of the first of some unsafe inputs, FAULT_NONE if there are none. */
enum fault find_input_fault(uint8_t unsafe);
uint8_t find_unsafe_inputs(uint8_t inputs);
/* B16: returns whether the mirrors' scan head is ready; one that returns no status by its interface counts as ready. */
bool is_head_ready(const struct board *b);
/* B17: measures the mirrors; returns whether both follow their command. While a move settles, the last answer stands. */
bool measure_mirrors(struct board *b, uint64_t now_us);
/* B7: returns the settling time of a move. */
uint32_t settling_us(const struct board_limits *limits, uint32_t codes);
/* B9, B16, B17: returns the fault for which no pulse may begin now, FAULT_NONE if there is none. */
enum fault find_unsafe(struct board *b);
/* Encodes a message of the session; returns the number of bytes, 0 without a session. */
size_t encode_message(const struct board *b, uint8_t *wire, uint8_t type, const uint8_t *body, size_t n);
void send_message(struct board *b, uint8_t type, const uint8_t *body, size_t n);
void trace_gate(struct board *b, bool on, bool is_point, uint32_t index_or_reason);
void command_gate(struct board *b, bool on, uint16_t duty);
/* Changes to the state that the event leads to. */
void change_state(struct board *b, enum reason event);
void disarm(struct board *b, enum reason reason);
void enter_fault(struct board *b, enum fault fault);
void drop_queue(struct board *b);

bool has_enough_points(const struct board *b);
void advance_point(struct board *b);
void resume_if_refilled(struct board *b);
void record_execution(struct board *b, uint64_t on_at_us, uint64_t on_us);

/* Carries out a message that is not sequenced. */
void on_hello(struct board *b, const struct frame *frame);
void handle_unsequenced(struct board *b, const struct frame *frame);
/* Carries out a sequenced message; returns the NAK reason, or NO_REFUSAL. */
uint8_t dispatch_sequenced(struct board *b, const struct frame *frame);

#endif
