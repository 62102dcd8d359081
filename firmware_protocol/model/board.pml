/* Model of the link, the gate and a host that may fail at any moment, small enough for an exhaustive search.

   A host connects, a user arms, points are streamed through a line that loses, duplicates and delays frames, and leases
   are renewed while the host is alive. Hosts stop or hang between any two steps; another one connects. Time advances
   nondeterministically in ticks of half a lease.

   The line injects LINE_FAULTS_MAX faults and replays an arming once; more faults enlarge the search without new results.

   Verified for all interleavings:
     the gate is never on outside RUNNING, or without a lease (B1, B3)
     the gate is never on in a session in which no user armed; a reconnection or a replay does not arm (B11)
     no point is executed twice, omitted or out of order (B12)
     the gate is never on without a queued point (B2)
     the gate is never on for longer than a lease after the host's last message

     the board changes its state only as the table of messages.toml permits (transitions.pml, generated from it)

   MUTANT=n, 1 to 6, removes one rule; 7 and 8 make a change that the table does not have. The search must find a violation.

   spin -a board.pml && gcc -O3 -DSAFETY -o pan pan.c && ./pan -m2000000 -w24      4 million states, some seconds */

#ifndef MUTANT
#define MUTANT 0
#endif

#if MUTANT == 4 || MUTANT == 3
#define IS_NEXT_INDEX(index) true
#else
#define IS_NEXT_INDEX(index) (index == first + queued)
#endif
#if MUTANT == 5
#define NEW_NONCE nonce
#else
#define NEW_NONCE nonce + 1
#endif
#if MUTANT == 3
#define ON_DUPLICATE(kind, argument) carry_out(kind, argument)
#else
#define ON_DUPLICATE(kind, argument) skip
#endif
#if MUTANT == 6
#define ON_EMPTY_QUEUE become(HOLD)
#define ON_POINT_END skip
#else
#define ON_EMPTY_QUEUE close_gate(HOLD)
#define ON_POINT_END gate = false
#endif
#if MUTANT == 2
#define ON_HELLO skip
#else
#define ON_HELLO close_gate(DISARMED)
#endif
#if MUTANT == 1
#define LEASE_ENDS false
#else
#define LEASE_ENDS (lease == 0 && leased)
#endif

#if MUTANT == 7
#define ON_START become(HOLD)
#else
#define ON_START become(RUNNING)
#endif
#if MUTANT == 8
#define IS_CONFIRMABLE (state == ARMING || state == DISARMED)
#else
#define IS_CONFIRMABLE (state == ARMING)
#endif

#include "transitions.pml"

#define POINTS 2      /* of a job */
#define SEQS 4        /* sequence numbers, fewer than all messages, so that they wrap */
#define WINDOW 2
#define LEASE 2       /* ticks */
#ifndef LINE_FAULTS_MAX
#define LINE_FAULTS_MAX 1
#endif
#define SESSIONS 2    /* consecutive hosts */

mtype = { HELLO, ARM_REQ, CONFIRM, DATA, START, END, RENEW, ABORT, REPLY, CHALLENGE, ACK };
mtype = { DISARMED, ARMING, ARMED, RUNNING, HOLD, FAULT };

/* kind, session, seq, argument (nonce, index or next seq) */
chan down = [1] of { mtype, byte, byte, byte };
chan up = [1] of { mtype, byte, byte, byte };

/* --- the board ---------------------------------------------------------------------------------------------------- */

mtype state = DISARMED;
bool gate, nonce_good, ends;
byte session, expected, lease, nonce = 1, queued, first, executed;

/* --- state that the board does not know ----------------------------------------------------------------------------------- */

byte host;            /* the living host's number, 0: none */
byte armed_session;      /* the session in which a user armed */
byte silent_ticks;          /* ticks since the board's last message from a live host */
byte recorded_nonce;      /* nonce that a recorder of the line could replay */

#define leased (state == ARMING || state == ARMED || state == RUNNING || state == HOLD)

inline become(next) { assert(state == next || IS_TRANSITION(state, next)); state = next }
inline close_gate(next) { gate = false; become(next) }
inline drop() { queued = 0; ends = false }

inline send(what, value) {
    if
    :: nfull(up) -> up!what, session, 0, value
    :: full(up) /* not read: lost */
    fi
}

inline check() {
    assert(!gate || state == RUNNING);
    assert(!gate || lease > 0);
    assert(!gate || queued > 0);
    assert(!gate || armed_session == session);
    assert(!gate || silent_ticks <= LEASE)
}

inline carry_out(kind, argument) {
    if
    :: kind == ARM_REQ && state == DISARMED ->
        become(ARMING); lease = LEASE; nonce_good = true; nonce = NEW_NONCE;
        send(CHALLENGE, nonce)
    :: kind == CONFIRM && IS_CONFIRMABLE && nonce_good && argument == nonce ->
        become(ARMED); nonce_good = false
    :: kind == CONFIRM && state == ARMING && !(nonce_good && argument == nonce) ->
        close_gate(DISARMED); nonce_good = false; drop()
    :: kind == DATA && (state == ARMED || state == RUNNING || state == HOLD) && IS_NEXT_INDEX(argument) ->
        assert(argument == first + queued);
        queued = queued + 1;
        if
        :: state == HOLD -> become(RUNNING)
        :: else
        fi
    :: kind == START && state == ARMED -> ON_START
    :: kind == END && (state == RUNNING || state == HOLD) && argument == first + queued ->
        ends = true;
        if
        :: queued == 0 -> close_gate(ARMED); drop()
        :: else
        fi
    :: else /* refused */
    fi
}

active proctype Board() {
    mtype kind; byte from, seq, argument;
end:
    do
    :: atomic { down?kind, from, seq, argument ->
        if
        :: kind == ABORT ->
            if
            :: state != FAULT -> close_gate(DISARMED)
            :: else
            fi;
            drop()
        :: kind == HELLO ->
            ON_HELLO; /* also in FAULT, a simplification: the connecting host acknowledges it */
            drop(); session = argument; expected = 0; first = 0; executed = 0; nonce_good = false;
            silent_ticks = 0;
            send(REPLY, argument)
        :: kind == RENEW && from == session && leased -> lease = LEASE; silent_ticks = 0
        :: kind == RENEW && !(from == session && leased)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from == session && seq == expected ->
            silent_ticks = 0;
            carry_out(kind, argument);
            expected = (expected + 1) % SEQS;
            send(ACK, expected)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from == session && seq != expected ->
            ON_DUPLICATE(kind, argument);
            send(ACK, expected)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from != session
        fi;
        check(); kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { state == RUNNING && !gate && queued > 0 -> gate = true; check() }
    :: atomic { gate ->
        assert(first == executed);
        executed = executed + 1;
        first = first + 1; queued = queued - 1;
        ON_POINT_END;
        if
        :: queued > 0 -> skip
        :: queued == 0 && ends -> close_gate(ARMED); drop()
        :: queued == 0 && !ends -> ON_EMPTY_QUEUE
        fi;
        check() }
    od
}

/* Ticks are nondeterministic; time between them is not modelled. */
active proctype Time() {
end:
    do
    :: atomic { (leased || silent_ticks <= LEASE) && (leased || host == 0) ->
        if
        :: silent_ticks <= LEASE -> silent_ticks = silent_ticks + 1
        :: else
        fi;
        if
        :: lease > 0 -> lease = lease - 1
        :: else
        fi;
        if
        :: LEASE_ENDS -> close_gate(FAULT); drop()
        :: else
        fi;
        check() }
    od
}

/* The line may lose or duplicate its first frame; a copy may arrive at any later time, as a retransmission does; an old
   CONFIRM may be replayed. */
active proctype Line() {
    mtype kind; byte from, seq, argument; bool held;
    mtype held_kind; byte held_from, held_seq, held_argument, line_faults, replayed;
end:
    do
    :: atomic { nempty(down) && line_faults < LINE_FAULTS_MAX -> line_faults = line_faults + 1; down?kind, from, seq, argument; kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { nempty(up) && line_faults < LINE_FAULTS_MAX -> line_faults = line_faults + 1; up?kind, from, seq, argument; kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { nempty(down) && !held && line_faults < LINE_FAULTS_MAX ->
        line_faults = line_faults + 1; down?<held_kind, held_from, held_seq, held_argument>; held = true }
    :: atomic { held && nfull(down) -> down!held_kind, held_from, held_seq, held_argument;
        held = false; held_kind = 0; held_from = 0; held_seq = 0; held_argument = 0 }
    :: atomic { recorded_nonce > 0 && armed_session != session && replayed < 2 && nfull(down) ->
        replayed = replayed + 1;
        if
        :: down!ARM_REQ, session, expected, 0
        :: down!CONFIRM, session, expected, recorded_nonce
        fi }
    od
}

/* --- consecutive hosts; each may stop between any two steps ------------------------------------------------ */

proctype Host(byte me; bool arms) {
    mtype kind; byte from, base, next, argument, sent, challenge;
    bool hello_sent, connected, confirmed, started, aborted;
    do
    :: break                                                    /* it stops or hangs */
    :: atomic { !hello_sent && nfull(down) -> hello_sent = true; down!HELLO, 0, 0, me }
    :: atomic { connected && arms && nfull(down) && lease < LEASE -> down!RENEW, me, 0, 0 }
    :: atomic { confirmed && !aborted && nfull(down) -> aborted = true; down!ABORT, 0, 0, 0 }
    :: atomic { connected && arms && next == base && !confirmed && challenge == 0 && nfull(down) ->
        armed_session = me; down!ARM_REQ, me, next, 0; next = (next + 1) % SEQS }
    :: atomic { connected && armed_session == me && challenge > 0 && !confirmed && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        recorded_nonce = challenge; confirmed = true; down!CONFIRM, me, next, challenge; next = (next + 1) % SEQS }
    /* A host that does not arm streams as well; none of its points may be executed. */
    :: atomic { connected && (confirmed || !arms) && sent < POINTS && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        down!DATA, me, next, sent; sent = sent + 1; next = (next + 1) % SEQS }
    :: atomic { connected && sent > 0 && !started && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        started = true; down!START, me, next, 0; next = (next + 1) % SEQS }
    :: atomic { connected && sent == POINTS && started && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        down!END, me, next, sent; next = (next + 1) % SEQS; sent = sent + 1 }
    :: atomic { up?kind, from, _, argument ->
        if
        :: kind == REPLY && argument == me -> connected = true
        :: kind == CHALLENGE && from == me -> challenge = argument
        :: kind == ACK && from == me && (argument + SEQS - base) % SEQS <= (next + SEQS - base) % SEQS -> base = argument
        :: else
        fi }
    od;
    atomic { host = 0 }
}

init {
    byte n = 0;
    do
    :: atomic { n < SESSIONS && host == 0 ->
        n = n + 1; host = n;
        if
        :: run Host(n, true)
        :: run Host(n, false)
        fi }
    :: n == SESSIONS && host == 0 -> break
    od
}
