/* Model of the epochs of the link process: pushes are accepted, STOP and other ends of an epoch come at any moment, pushes
   are handed over late, and users pause, resume and arm again.

   The web process stamps each push with the epoch that it has seen last, which may be an older one. The planner hands
   over each push at any later moment. The link process refuses pushes of another epoch (gate 1), sends only while it
   sees the board armed, and drops at arming what was handed over before (gate 2). STOP, the loss of planner or web, and
   the loss of the link send ABORT, which may be lost, and begin a new session; disarm travels behind points already sent.

   A pause sends FLUSH behind the points already sent and drops those that wait. While the light is paused, the link process
   refuses points (gate 3), and always those that were built before the last pause (gate 4). Once the board has flushed,
   the planner hands over the rest of its last push at any later moment, with the epoch of this push (gate 5).

   The planner keeps the order of pushes: they do not interact.

   Verified for all interleavings:
     the board emits a push only if it was accepted in the epoch in which the board was armed
     after STOP has begun a new session, the board is disarmed until a user arms it again
     after a pause has flushed the board, it emits nothing until the end of the pause, and then no points built before

   MUTANT=1 to 5 removes the gate of this number; the search must find a violation.

   spin -a epochs.pml && gcc -O3 -DSAFETY -o pan pan.c && ./pan -m2000000 -w24      2 million states, some seconds */

#ifndef MUTANT
#define MUTANT 0
#endif

#if MUTANT == 1
#define IS_CURRENT(stamp) true
#else
#define IS_CURRENT(stamp) (stamp == epoch)
#endif
#if MUTANT == 2
#define DROP_HELD_POINTS skip
#else
#define DROP_HELD_POINTS job = 0
#endif

#if MUTANT == 3
#define IS_LIT true
#else
#define IS_LIT (!paused)
#endif
#if MUTANT == 4
#define IS_RECENT(points) true
#else
#define IS_RECENT(points) (PAUSE(points) == pause)
#endif
#if MUTANT == 5
#define STAMP_REST stamp[rest] = epoch
#else
#define STAMP_REST skip
#endif

#define PUSHES 2
#define ENDS 2        /* of epochs */
#define ARMINGS 2
#define PAUSES 1

#define POINTS(push, number) (push + 4 * (number))    /* of a push, built after a pause */
#define PUSH(points) (points % 4)
#define PAUSE(points) (points / 4)

mtype = { ABORT, HELLO, ARM_REQ, CONFIRM, DISARM, DATA, FLUSH, REPLY, CHALLENGE, ENTERED };
mtype = { DISARMED, ARMING, ARMED, FAULT };

chan handover = [1] of { byte };               /* points */
chan down = [2] of { mtype, byte, byte };      /* kind, session, points, pause or nonce */
chan up = [1] of { mtype, byte, mtype, byte }; /* kind, session, state, nonce */

/* --- the link process --- */
byte epoch = 1, session = 1, job, nonce;
byte pause;                   /* number of the last one */
bool held, connected = true, paused, flushing;
mtype view = DISARMED;

/* --- the board --- */
mtype state = DISARMED;
byte board_session = 1, challenge;

/* --- the web process and the planner --- */
byte seen = 1, pushes;
byte stamp[PUSHES + 1];
byte drained, rest;           /* last pause that the planner knows; push whose rest is to be handed over */

/* --- what no process knows --- */
byte accepted[PUSHES + 1];    /* epoch in which each push was accepted */
byte armed_epoch, ends, armings;
byte flushed;                 /* last pause for which the board has flushed */
bool stopped;                 /* a new session has begun since a user armed */

inline end_epoch() { ends = ends + 1; epoch = epoch + 1; held = true; nonce = 0; paused = false }

inline report(kind, what, value) {
    if
    :: nfull(up) -> up!kind, board_session, what, value
    :: full(up) /* lost: a status repeats the state, see Board; a challenge, and so the arming, is lost */
    fi
}

active proctype Board() {
    mtype kind; byte from, argument;
end:
    do
    :: atomic { down?kind, from, argument ->
        if
        :: kind == ABORT -> state = (state == FAULT -> FAULT : DISARMED)
        :: kind == HELLO ->
            state = (state == FAULT -> FAULT : DISARMED); board_session = from; stopped = true;
            report(REPLY, state, 0)
        :: kind == ARM_REQ && from == board_session && state == DISARMED ->
            state = ARMING; challenge = argument; report(CHALLENGE, ARMING, argument)
        :: kind == CONFIRM && from == board_session && state == ARMING && argument == challenge ->
            state = ARMED; armed_epoch = epoch; stopped = false; report(ENTERED, ARMED, 0)
        :: kind == DISARM && from == board_session -> state = DISARMED; report(ENTERED, DISARMED, 0)
        :: kind == DATA && from == board_session && state == ARMED ->
            assert(accepted[PUSH(argument)] == armed_epoch);
            assert(!stopped);
            assert(!(paused && flushed == pause));
            assert(PAUSE(argument) >= flushed)
        :: kind == FLUSH && from == board_session -> flushed = argument; flushing = false
        :: else
        fi;
        kind = 0; from = 0; argument = 0 }
    :: atomic { (state == ARMED || state == ARMING) && ends < ENDS -> state = FAULT; report(ENTERED, FAULT, 0) }
    :: atomic { nfull(up) && view != state && board_session == session -> up!ENTERED, board_session, state, 0 }
    od
}

active proctype Link() {
    mtype kind, what; byte from, value, points;
end:
    do
    /* STOP, the end of planner or web, the loss of the link */
    :: atomic { ends < ENDS && nfull(down) ->
        end_epoch(); connected = false; session = session + 1; flushing = false;
        if
        :: down!ABORT, 0, 0
        :: skip /* the line loses it */
        fi }
    :: atomic { !connected && nfull(down) -> down!HELLO, session, 0 }
    :: atomic { ends < ENDS && connected && nfull(down) -> end_epoch(); down!DISARM, session, 0 }
    :: atomic { view == FAULT && connected && nfull(down) && ends < ENDS -> end_epoch(); down!DISARM, session, 0 }
    :: atomic { up?kind, from, what, value ->
        if
        :: from == session ->
            if
            :: what == FAULT && view != FAULT && ends < ENDS -> end_epoch()
            :: else
            fi;
            view = what; connected = (kind == REPLY -> true : connected);
            if
            :: kind == CHALLENGE && value == nonce && nonce > 0 && len(down) < 2 -> down!CONFIRM, session, nonce; nonce = 0
            :: else /* not asked for, or no room: the arming times out */
            fi
        :: else
        fi;
        kind = 0; from = 0; what = 0; value = 0 }
    :: atomic { handover?points ->
        if
        :: IS_CURRENT(stamp[PUSH(points)]) && IS_LIT && IS_RECENT(points) && connected && view == ARMED && job == 0 ->
            job = points
        :: else /* refused */
        fi;
        points = 0 }
    :: atomic { connected && !held && job != 0 && view == ARMED && nfull(down) -> down!DATA, session, job; job = 0 }
    :: atomic { connected && view == DISARMED && armings < ARMINGS && nfull(down) ->
        armings = armings + 1; DROP_HELD_POINTS; held = false; nonce = armings; down!ARM_REQ, session, nonce }
    :: atomic { connected && view == ARMED && !paused && pause < PAUSES && nfull(down) ->
        pause = pause + 1; paused = true; flushing = true; job = 0; down!FLUSH, session, pause }
    :: atomic { paused -> paused = false }
    od
}

active proctype Web() {
end:
    do
    :: atomic { seen != epoch -> seen = epoch }
    :: atomic { pushes < PUSHES -> pushes = pushes + 1; stamp[pushes] = seen; accepted[pushes] = epoch }
    od
}

active proctype Planner() {
    byte next = 1;
end:
    do
    :: atomic { next <= pushes && nfull(handover) -> handover!POINTS(next, drained); next = next + 1 }
    :: atomic { drained != pause && !flushing -> drained = pause; rest = next - 1 }
    :: atomic { rest != 0 && nfull(handover) -> STAMP_REST; handover!POINTS(rest, drained); rest = 0 }
    od
}
