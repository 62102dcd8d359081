/* Where the witness finds what it reads of the port's memory, and writes the settings. */
#include "core.h"

#define AT(member) (uint32_t)offsetof(struct board, member)
__attribute__((section(".offsets"), used)) static const uint32_t offsets[] = {
    AT(now_us), AT(state), AT(fault), AT(current_index), AT(current_point.x), AT(current_point.y), AT(current_point.duty),
    AT(link.receiver.crc_errors), AT(link.receiver.format_errors),
};
