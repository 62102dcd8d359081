/* The emulator's host: one command at a time in, records out, through files that QEMU opens (semihosting). A read waits
   in the emulator, which costs the chip no time. */

#ifndef BENCH_H
#define BENCH_H

#include <stddef.h>
#include <stdint.h>

#define COMMAND_BYTES 256u

struct __attribute__((packed)) command {
    uint64_t at_us; /* RUN: time until which the chip runs */
    uint16_t length;
    uint8_t kind;
    uint8_t bytes[COMMAND_BYTES];
};

void bench_open(void);
/* Waits for a command. Ends the emulator if there are no more. */
void bench_read(struct command *command);
/* Writes a record of at most COMMAND_BYTES bytes. */
void bench_write(char kind, const void *bytes, size_t n);

#endif
