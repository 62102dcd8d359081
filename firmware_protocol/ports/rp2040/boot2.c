/* The second stage that the chip's ROM wants: the flash's first 256 bytes, which it copies to RAM, checks (CRC in the last
   four, put there by image.py) and runs. It makes the flash readable as memory, by the plain read command that every
   serial flash knows, and goes on at the vector table behind it. It may be anywhere: no calls, no data but its own. */

#include "registers.h"

#define VECTORS 0x10000100u
#define READ_COMMAND 0x03u

__attribute__((section(".boot2"), used, noreturn)) void boot2(void) {
    REGISTER(SSI_SSIENR) = 0;
    REGISTER(SSI_BAUDR) = 4; /* of 125 MHz later: 31 MHz, the command is good for 50 */
    REGISTER(SSI_CTRLR0) = 31u << 16 | 3u << 8; /* one wire, words of 32 bits, "EEPROM read" */
    REGISTER(SSI_CTRLR1) = 0; /* one word at a time */
    REGISTER(SSI_SPI_CTRLR0) = READ_COMMAND << 24 | 2u << 8 | 6u << 2; /* 8 bits of command, 24 of address */
    REGISTER(SSI_SER) = 1;
    REGISTER(SSI_SSIENR) = 1;
    REGISTER(VTOR) = VECTORS;
    __asm volatile("msr msp, %0\n\tbx %1" ::"r"(REGISTER(VECTORS)), "r"(REGISTER(VECTORS + 4u)));
    __builtin_unreachable();
}
