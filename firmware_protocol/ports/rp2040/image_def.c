/* The block by which the RP2350's ROM recognises an image in the flash: executable, secure, Arm, and no other block. The ROM maps
   the flash itself and starts at the vector table, the image's first bytes. */

#include <stdint.h>

__attribute__((section(".image_def"), used)) static const uint32_t image_def[] = {
    0xffffded3u, 0x10210142u, 0x000001ffu, 0u, 0xab123579u,
};
