/* Second-stage boot loader: the first 256 bytes of the flash, which the chip's ROM copies to RAM, checks (CRC in the last
   four bytes, inserted by image.py) and runs. It maps the flash as memory with the basic read command of every serial
   flash and continues at the vector table behind it. Position-independent: no calls, no external data. */

#include "registers.h"

#define VECTORS 0x10000100u
#define READ_COMMAND 0x03u

__attribute__((section(".boot2"), used, noreturn)) void boot2(void) {
    REGISTER(SSI_SSIENR) = 0;
    REGISTER(SSI_BAUDR) = 4; /* divides 125 MHz to 31 MHz; the command permits 50 MHz */
    REGISTER(SSI_CTRLR0) = 31u << 16 | 3u << 8; /* one data line, 32-bit words, "EEPROM read" */
    REGISTER(SSI_CTRLR1) = 0; /* one word at a time */
    REGISTER(SSI_SPI_CTRLR0) = READ_COMMAND << 24 | 2u << 8 | 6u << 2; /* 8 bits of command, 24 of address */
    REGISTER(SSI_SER) = 1;
    REGISTER(SSI_SSIENR) = 1;
    REGISTER(VTOR) = VECTORS;
    __asm volatile("msr msp, %0\n\tbx %1" ::"r"(REGISTER(VECTORS)), "r"(REGISTER(VECTORS + 4u)));
    __builtin_unreachable();
}
