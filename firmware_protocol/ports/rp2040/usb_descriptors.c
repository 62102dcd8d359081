#include "usb_descriptors.h"

#include <stdbool.h>

#define UID_BYTES 12u
#define LOW(value) ((value) & 0xffu)
#define HIGH(value) ((value) >> 8)

enum { DEVICE = 1, CONFIGURATION, STRING, INTERFACE, ENDPOINT, ASSOCIATION = 11, CLASS_SPECIFIC = 0x24 };
enum { LANGUAGE, MANUFACTURER, PRODUCT, SERIAL_NUMBER, STRINGS };

static const uint8_t DEVICE_DESCRIPTOR[] = {
    18, DEVICE, 0x00, 0x02,           /* USB 2.0 */
    0xef, 2, 1,                       /* class by association of interfaces */
    USB_PACKET, 0x09, 0x12, 0x01, 0x00, /* pid.codes' number for tests: get an own one before you sell boards */
    0x00, 0x01, MANUFACTURER, PRODUCT, SERIAL_NUMBER, 1,
};

#define CONFIGURATION_BYTES 75u
static const uint8_t CONFIGURATION_DESCRIPTOR[CONFIGURATION_BYTES] = {
    9, CONFIGURATION, LOW(CONFIGURATION_BYTES), HIGH(CONFIGURATION_BYTES), 2, 1, 0, 0x80, 125, /* powered by the bus, 250 mA */
    8, ASSOCIATION, 0, 2, 2, 2, 0, 0,
    9, INTERFACE, 0, 0, 1, 2, 2, 0, 0, /* communication, abstract control model */
    5, CLASS_SPECIFIC, 0, 0x20, 0x01,
    5, CLASS_SPECIFIC, 1, 0, 1,
    4, CLASS_SPECIFIC, 2, 0x06, /* line coding and state, BREAK */
    5, CLASS_SPECIFIC, 6, 0, 1,
    7, ENDPOINT, 0x80 | USB_NOTIFY, 3, 8, 0, 255,
    9, INTERFACE, 1, 0, 2, 10, 0, 0, 0, /* data */
    7, ENDPOINT, USB_DATA, 2, USB_PACKET, 0, 0,
    7, ENDPOINT, 0x80 | USB_DATA, 2, USB_PACKET, 0, 0,
};

static const char *const TEXTS[STRINGS] = {[MANUFACTURER] = "optodrive", [PRODUCT] = "optodrive board"};

static char serial_number[2 * UID_BYTES + 1];

void usb_describe(const uint8_t *uid) {
    static const char DIGITS[] = "0123456789abcdef";
    for (size_t k = 0; k < 2 * UID_BYTES; k++) {
        serial_number[k] = DIGITS[k % 2 == 0 ? uid[k / 2] >> 4 : uid[k / 2] & 15u];
    }
}

static const uint8_t *find_string(uint8_t number, size_t *length) {
    static uint8_t descriptor[2 + 4 * UID_BYTES]; /* UTF-16 */
    size_t n = 2;
    if (number == LANGUAGE) {
        descriptor[n++] = 0x09; /* English */
        descriptor[n++] = 0x04;
    } else {
        const char *text = number == SERIAL_NUMBER ? serial_number : TEXTS[number];
        for (; *text && n < sizeof descriptor; text++) {
            descriptor[n++] = (uint8_t)*text;
            descriptor[n++] = 0;
        }
    }
    descriptor[0] = (uint8_t)n;
    descriptor[1] = STRING;
    *length = n;
    return descriptor;
}

const uint8_t *usb_find_descriptor(uint8_t type, uint8_t number, size_t *length) {
    if (type == DEVICE) {
        *length = sizeof DEVICE_DESCRIPTOR;
        return DEVICE_DESCRIPTOR;
    }
    if (type == CONFIGURATION && number == 0) {
        *length = sizeof CONFIGURATION_DESCRIPTOR;
        return CONFIGURATION_DESCRIPTOR;
    }
    return type == STRING && number < STRINGS ? find_string(number, length) : NULL;
}
