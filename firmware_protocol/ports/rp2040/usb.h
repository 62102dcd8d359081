/* USB device with a virtual serial port (CDC ACM). The main loop serves it: it raises no interrupt, so no tick waits for it. What
   the loop has not looked at yet, the controller holds and refuses by itself (NAK). */

#ifndef USB_H
#define USB_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Shows the device to the computer. uid: 12 bytes, the serial number. */
void usb_start(const uint8_t *uid);
/* Carries out what the bus asks for, at most one request: a port that closes and opens again is seen closed in between. */
void usb_serve(void);
/* Whether a program has the port open on a computer that is there and awake. */
bool usb_is_open(void);
/* Returns whether the program sent a BREAK since the last call. */
bool usb_pop_break(void);
/* Reads up to size received bytes, none beyond the end of a frame. */
size_t usb_read(uint8_t *bytes, size_t size);
/* Discards the received bytes. */
void usb_skip(void);
/* Gives the controller a packet of what is outgoing, if it has sent the last one. */
void usb_transmit(void);

#endif
