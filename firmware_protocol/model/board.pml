/* The link, the gate and a host that may die at any moment, small enough to be explored whole.

   A host connects, a user arms, points are streamed through a line that loses, repeats and holds back frames, leases
   are renewed while the host lives. Hosts die or hang between any two steps; another connects. Time passes in ticks of
   half a lease, whenever it likes.

   The line does MISCHIEF in all, and plays an arming back once; with more there is more to explore and nothing new.

   Never, whatever happens in whatever order:
     gate on outside RUNNING, or without a lease (B1, B3)
     gate on in a session in which no user armed; a reconnection or a replay arms nothing (B11)
     a point lit twice, left out or out of order (B12)
     gate on with nothing queued for it (B2)
     gate on longer than a lease after the host's last word

   MUTANT=n, 1 to 6, takes one rule away; each must be caught.

   spin -a board.pml && gcc -O3 -DSAFETY -o pan pan.c && ./pan -m2000000 -w24      4 million states, some seconds */

#ifndef MUTANT
#define MUTANT 0
#endif

#if MUTANT == 4 || MUTANT == 3
#define IN_PLACE(index) true
#else
#define IN_PLACE(index) (index == first + queued)
#endif
#if MUTANT == 5
#define FRESH nonce
#else
#define FRESH nonce + 1
#endif
#if MUTANT == 3
#define AGAIN(kind, argument) obey(kind, argument)
#else
#define AGAIN(kind, argument) skip
#endif
#if MUTANT == 6
#define EMPTY_IS_DARK state = HOLD
#define POINT_ENDS skip
#else
#define EMPTY_IS_DARK dark(HOLD)
#define POINT_ENDS gate = false
#endif
#if MUTANT == 2
#define FORGET_ARMING skip
#else
#define FORGET_ARMING dark(DISARMED)
#endif
#if MUTANT == 1
#define LEASE_ENDS false
#else
#define LEASE_ENDS (lease == 0 && leased)
#endif

#define POINTS 2      /* of a job */
#define SEQS 4        /* sequence numbers, fewer than points and orders together: they come round */
#define WINDOW 2
#define LEASE 2       /* ticks */
#ifndef MISCHIEF
#define MISCHIEF 1
#endif
#define SESSIONS 2    /* hosts that come one after the other */

mtype = { HELLO, ARM_REQ, CONFIRM, DATA, START, END, RENEW, ABORT, REPLY, CHALLENGE, ACK };
mtype = { DISARMED, ARMING, ARMED, RUNNING, HOLD, FAULT };

/* kind, session, seq, argument (nonce, index or next seq) */
chan down = [1] of { mtype, byte, byte, byte };
chan up = [1] of { mtype, byte, byte, byte };

/* --- the board ---------------------------------------------------------------------------------------------------- */

mtype state = DISARMED;
bool gate, nonce_good, ends;
byte session, expected, lease, nonce = 1, queued, first, executed;

/* --- what the board cannot know ----------------------------------------------------------------------------------- */

byte host;            /* the living host's number, 0: none */
byte user_armed;      /* the session in which a user armed */
byte silent;          /* ticks since the board last heard a host that lives */
byte said_nonce;      /* what a recorder of the line could play back */

#define leased (state == ARMING || state == ARMED || state == RUNNING || state == HOLD)

inline dark(next) { gate = false; state = next }
inline drop() { queued = 0; ends = false }

inline say(what, value) {
    if
    :: nfull(up) -> up!what, session, 0, value
    :: full(up) /* nobody reads: it is lost */
    fi
}

inline check() {
    assert(!gate || state == RUNNING);
    assert(!gate || lease > 0);
    assert(!gate || queued > 0);
    assert(!gate || user_armed == session);
    assert(!gate || silent <= LEASE)
}

inline obey(kind, argument) {
    if
    :: kind == ARM_REQ && state == DISARMED ->
        state = ARMING; lease = LEASE; nonce_good = true; nonce = FRESH;
        say(CHALLENGE, nonce)
    :: kind == CONFIRM && state == ARMING && nonce_good && argument == nonce ->
        state = ARMED; nonce_good = false
    :: kind == CONFIRM && state == ARMING && !(nonce_good && argument == nonce) ->
        dark(DISARMED); nonce_good = false; drop()
    :: kind == DATA && (state == ARMED || state == RUNNING || state == HOLD) && IN_PLACE(argument) ->
        assert(argument == first + queued);
        queued = queued + 1;
        if
        :: state == HOLD -> state = RUNNING
        :: else
        fi
    :: kind == START && state == ARMED -> state = RUNNING
    :: kind == END && (state == RUNNING || state == HOLD) && argument == first + queued ->
        ends = true;
        if
        :: queued == 0 -> dark(ARMED); drop()
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
            :: state != FAULT -> dark(DISARMED)
            :: else
            fi;
            drop()
        :: kind == HELLO ->
            FORGET_ARMING; /* of a FAULT too, for the model's sake: whoever connects acknowledges it */
            drop(); session = argument; expected = 0; first = 0; executed = 0; nonce_good = false;
            silent = 0;
            say(REPLY, argument)
        :: kind == RENEW && from == session && leased -> lease = LEASE; silent = 0
        :: kind == RENEW && !(from == session && leased)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from == session && seq == expected ->
            silent = 0;
            obey(kind, argument);
            expected = (expected + 1) % SEQS;
            say(ACK, expected)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from == session && seq != expected ->
            AGAIN(kind, argument);
            say(ACK, expected)
        :: kind != ABORT && kind != HELLO && kind != RENEW && from != session
        fi;
        check(); kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { state == RUNNING && !gate && queued > 0 -> gate = true; check() }
    :: atomic { gate ->
        assert(first == executed);
        executed = executed + 1;
        first = first + 1; queued = queued - 1;
        POINT_ENDS;
        if
        :: queued > 0 -> skip
        :: queued == 0 && ends -> dark(ARMED); drop()
        :: queued == 0 && !ends -> EMPTY_IS_DARK
        fi;
        check() }
    od
}

/* Ticks come whenever they like: time is not counted between them. A board with a lease left may be lit. */
active proctype Time() {
end:
    do
    :: atomic { (leased || silent <= LEASE) && (leased || host == 0) ->
        if
        :: silent <= LEASE -> silent = silent + 1
        :: else
        fi;
        if
        :: lease > 0 -> lease = lease - 1
        :: else
        fi;
        if
        :: LEASE_ENDS -> dark(FAULT); drop()
        :: else
        fi;
        check() }
    od
}

/* The line: what waits at its head may be lost, or come twice; a copy may come at any later time, as what a host sends
   again does; an old CONFIRM may be played back. */
active proctype Line() {
    mtype kind; byte from, seq, argument; bool held;
    mtype held_kind; byte held_from, held_seq, held_argument, done, replayed;
end:
    do
    :: atomic { nempty(down) && done < MISCHIEF -> done = done + 1; down?kind, from, seq, argument; kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { nempty(up) && done < MISCHIEF -> done = done + 1; up?kind, from, seq, argument; kind = 0; from = 0; seq = 0; argument = 0 }
    :: atomic { nempty(down) && !held && done < MISCHIEF ->
        done = done + 1; down?<held_kind, held_from, held_seq, held_argument>; held = true }
    :: atomic { held && nfull(down) -> down!held_kind, held_from, held_seq, held_argument;
        held = false; held_kind = 0; held_from = 0; held_seq = 0; held_argument = 0 }
    :: atomic { said_nonce > 0 && user_armed != session && replayed < 2 && nfull(down) ->
        replayed = replayed + 1;
        if
        :: down!ARM_REQ, session, expected, 0
        :: down!CONFIRM, session, expected, said_nonce
        fi }
    od
}

/* --- hosts: one after the other; each may die between any two steps ------------------------------------------------ */

proctype Host(byte me; bool arms) {
    mtype kind; byte from, base, next, argument, sent, challenge;
    bool greeted, known, confirmed, started, gave_up;
    do
    :: break                                                    /* it dies, or hangs for good */
    :: atomic { !greeted && nfull(down) -> greeted = true; down!HELLO, 0, 0, me }
    :: atomic { known && arms && nfull(down) && lease < LEASE -> down!RENEW, me, 0, 0 }
    :: atomic { confirmed && !gave_up && nfull(down) -> gave_up = true; down!ABORT, 0, 0, 0 }
    :: atomic { known && arms && next == base && !confirmed && challenge == 0 && nfull(down) ->
        user_armed = me; down!ARM_REQ, me, next, 0; next = (next + 1) % SEQS }
    :: atomic { known && user_armed == me && challenge > 0 && !confirmed && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        said_nonce = challenge; confirmed = true; down!CONFIRM, me, next, challenge; next = (next + 1) % SEQS }
    /* A host that does not arm streams all the same: nothing of it may be lit. */
    :: atomic { known && (confirmed || !arms) && sent < POINTS && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        down!DATA, me, next, sent; sent = sent + 1; next = (next + 1) % SEQS }
    :: atomic { known && sent > 0 && !started && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        started = true; down!START, me, next, 0; next = (next + 1) % SEQS }
    :: atomic { known && sent == POINTS && started && (next + SEQS - base) % SEQS < WINDOW && nfull(down) ->
        down!END, me, next, sent; next = (next + 1) % SEQS; sent = sent + 1 }
    :: atomic { up?kind, from, _, argument ->
        if
        :: kind == REPLY && argument == me -> known = true
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
