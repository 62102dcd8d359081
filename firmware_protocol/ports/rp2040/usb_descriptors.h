/* What the device says of itself. */

#ifndef USB_DESCRIPTORS_H
#define USB_DESCRIPTORS_H

#include <stddef.h>
#include <stdint.h>

#define USB_PACKET 64u
#define USB_NOTIFY 1u /* endpoint of notifications, required by the class and never used */
#define USB_DATA 2u   /* endpoint of data, both directions */

/* uid: 12 bytes, the serial number. */
void usb_describe(const uint8_t *uid);
/* Returns a descriptor and its length; NULL if the device has none of this type and number. */
const uint8_t *usb_find_descriptor(uint8_t type, uint8_t number, size_t *length);

#endif
