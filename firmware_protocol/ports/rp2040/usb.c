#include "usb.h"

#include "chip.h"
#include "outgoing.h"
#include "registers.h"
#include "usb_buffers.h"
#include "usb_descriptors.h"

#define CONTROL 0u
#define SENT_MAX (USB_PACKET - 1u) /* never a full packet: a computer waits for more after one */
#define BUS_LOST_US 4000u          /* a computer that is there and awake begins a frame every millisecond */
#define LINE_CODING_BYTES 7u

#define DPRAM(offset) (*(volatile uint8_t *)(USB_DPRAM + (offset)))
#define CONTROL_BUFFER 0x100u
#define IN_BUFFER 0x180u
#define OUT_BUFFER 0x1c0u
#define NOTIFY_BUFFER 0x200u

enum request {
    GET_STATUS = 0,
    CLEAR_FEATURE = 1,
    SET_ADDRESS = 5,
    GET_DESCRIPTOR = 6,
    GET_CONFIGURATION = 8,
    SET_CONFIGURATION = 9,
    GET_INTERFACE = 10,
    SET_INTERFACE = 11,
    SET_LINE_CODING = 0x20,
    GET_LINE_CODING = 0x21,
    SET_CONTROL_LINE_STATE = 0x22,
    SEND_BREAK = 0x23,
};

static struct {
    enum { IDLE, REPLY, STATUS_OF_REPLY, DATA_OF_REQUEST, STATUS_OF_REQUEST } stage; /* of the control request */
    const uint8_t *reply;
    size_t reply_length;
    uint8_t address, configuration;
    bool dtr, break_received;
    bool sending;
    uint32_t packet_at, packet_length; /* of received bytes */
    uint32_t frame;
    uint64_t frame_us;
    bool alive;
} usb;

/* 115200 baud, 8N1: a virtual port only keeps what it is told. */
static uint8_t line_coding[LINE_CODING_BYTES] = {0x00, 0xc2, 0x01, 0x00, 0, 0, 8};

/* --- control requests --- */

struct setup {
    uint8_t type, request;
    uint16_t value, index, length;
};

static void send_reply(void) {
    uint32_t n = 0;
    for (; n < USB_PACKET && usb.reply_length > 0; n++, usb.reply_length--) {
        DPRAM(CONTROL_BUFFER + n) = *usb.reply++;
    }
    buffer_arm(CONTROL, IN, n);
}

/* No reply fills its last packet, except one that the computer asked for in this length, so none needs an empty packet. */
static bool reply(const struct setup *setup, const uint8_t *bytes, size_t n) {
    usb.stage = REPLY;
    usb.reply = bytes;
    usb.reply_length = n < setup->length ? n : setup->length;
    send_reply();
    return true;
}

static bool acknowledge(void) {
    usb.stage = STATUS_OF_REQUEST;
    buffer_arm(CONTROL, IN, 0);
    return true;
}

static void configure(uint8_t configuration) {
    usb.configuration = configuration;
    usb.dtr = usb.sending = false;
    usb.packet_at = usb.packet_length = 0;
    buffer_count_from(USB_DATA, IN, 0);
    buffer_count_from(USB_DATA, OUT, 0);
    buffer_take_back(USB_DATA, IN);
    buffer_take_back(USB_DATA, OUT);
    if (configuration) {
        buffer_arm(USB_DATA, OUT, USB_PACKET);
    }
}

/* The packets of an endpoint count from DATA0 again; the buffer that the controller has is given anew. */
static void restart(enum way way) {
    bool armed = way == IN ? usb.sending : usb.packet_length == 0;
    uint32_t length = way == IN ? buffer_length(USB_DATA, IN) : USB_PACKET;
    buffer_count_from(USB_DATA, way, 0);
    if (armed) {
        buffer_take_back(USB_DATA, way);
        buffer_arm(USB_DATA, way, length);
    }
}

/* Carries out a standard request; returns false for one that the device does not know. */
static bool handle_standard(const struct setup *setup) {
    static const uint8_t ZEROS[2];
    size_t length;
    const uint8_t *descriptor;
    switch (setup->request) {
    case GET_STATUS:
        return reply(setup, ZEROS, 2);
    case GET_INTERFACE:
        return reply(setup, ZEROS, 1);
    case GET_CONFIGURATION:
        return reply(setup, &usb.configuration, 1);
    case GET_DESCRIPTOR:
        descriptor = usb_find_descriptor((uint8_t)(setup->value >> 8), (uint8_t)setup->value, &length);
        return descriptor && reply(setup, descriptor, length);
    case SET_ADDRESS:
        usb.address = setup->value & 0x7fu; /* from the next request on */
        return acknowledge();
    case SET_CONFIGURATION:
        if (setup->value > 1) {
            return false;
        }
        configure((uint8_t)setup->value);
        return acknowledge();
    case CLEAR_FEATURE:
        if ((setup->index & 0x7fu) == USB_DATA && usb.configuration) {
            restart((setup->index & 0x80u) ? IN : OUT);
        }
        return acknowledge();
    case SET_INTERFACE:
        return setup->value == 0 && acknowledge();
    default:
        return false;
    }
}

static bool handle_class(const struct setup *setup) {
    switch (setup->request) {
    case GET_LINE_CODING:
        return reply(setup, line_coding, sizeof line_coding);
    case SET_LINE_CODING:
        usb.stage = DATA_OF_REQUEST;
        buffer_arm(CONTROL, OUT, USB_PACKET);
        return true;
    case SET_CONTROL_LINE_STATE:
        usb.dtr = setup->value & 1u;
        return acknowledge();
    case SEND_BREAK:
        usb.break_received = usb.break_received || setup->value != 0; /* 0 ends it */
        return acknowledge();
    default:
        return false;
    }
}

static void refuse(void) {
    usb.stage = IDLE;
    SET(USB_STALL_ARM) = 3u; /* until the next request */
    REGISTER(USB_BUFFER_CONTROL(CONTROL, IN)) = USB_BUFFER_STALL;
    REGISTER(USB_BUFFER_CONTROL(CONTROL, OUT)) = USB_BUFFER_STALL;
}

/* A request ends the one before it. */
static void handle_setup(void) {
    struct setup setup = {
        .type = DPRAM(0),
        .request = DPRAM(1),
        .value = (uint16_t)(DPRAM(2) | DPRAM(3) << 8),
        .index = (uint16_t)(DPRAM(4) | DPRAM(5) << 8),
        .length = (uint16_t)(DPRAM(6) | DPRAM(7) << 8),
    };
    buffer_take_back(CONTROL, IN);
    buffer_take_back(CONTROL, OUT);
    buffer_count_from(CONTROL, IN, 1);
    buffer_count_from(CONTROL, OUT, 1);
    uint32_t kind = setup.type >> 5 & 3u;
    if (!(kind == 0 ? handle_standard(&setup) : kind == 1 && handle_class(&setup))) {
        refuse();
    }
}

static void on_control_sent(void) {
    if (usb.stage == REPLY && usb.reply_length > 0) {
        send_reply();
    } else if (usb.stage == REPLY) {
        usb.stage = STATUS_OF_REPLY;
        buffer_count_from(CONTROL, OUT, 1);
        buffer_arm(CONTROL, OUT, USB_PACKET);
    } else {
        usb.stage = IDLE;
        REGISTER(USB_ADDRESS) = usb.address;
    }
}

static void on_control_received(void) {
    bool is_data = usb.stage == DATA_OF_REQUEST;
    usb.stage = IDLE;
    if (!is_data) {
        return;
    }
    for (uint32_t k = 0; k < LINE_CODING_BYTES && k < buffer_length(CONTROL, OUT); k++) {
        line_coding[k] = DPRAM(CONTROL_BUFFER + k);
    }
    (void)acknowledge();
}

/* --- the bus --- */

static void reset_device(void) {
    CLEAR(USB_SIE_STATUS) = USB_SIE_BUS_RESET;
    usb.stage = IDLE;
    usb.address = 0;
    REGISTER(USB_ADDRESS) = 0;
    configure(0);
}

/* A suspended bus, a computer that is gone and an unplugged cable have one sign: no frame begins. */
static void watch_bus(void) {
    uint32_t frame = REGISTER(USB_FRAME);
    uint64_t now_us = chip_now_us();
    if (frame != usb.frame) {
        usb.frame = frame;
        usb.frame_us = now_us;
    }
    usb.alive = now_us - usb.frame_us < BUS_LOST_US;
}

void usb_serve(void) {
    watch_bus();
    if (REGISTER(USB_SIE_STATUS) & USB_SIE_BUS_RESET) {
        reset_device();
        return;
    }
    if (buffer_pop_done(CONTROL, IN)) {
        on_control_sent();
    }
    if (buffer_pop_done(CONTROL, OUT)) {
        on_control_received();
    }
    if (REGISTER(USB_SIE_STATUS) & USB_SIE_SETUP) {
        CLEAR(USB_SIE_STATUS) = USB_SIE_SETUP;
        handle_setup();
    }
    if (buffer_pop_done(USB_DATA, IN)) {
        usb.sending = false;
    }
    if (buffer_pop_done(USB_DATA, OUT)) {
        usb.packet_at = 0;
        usb.packet_length = buffer_length(USB_DATA, OUT);
        if (usb.packet_length == 0) {
            buffer_arm(USB_DATA, OUT, USB_PACKET);
        }
    }
}

bool usb_is_open(void) { return usb.configuration && usb.dtr && usb.alive; }

bool usb_pop_break(void) {
    bool break_received = usb.break_received;
    usb.break_received = false;
    return break_received;
}

/* --- data --- */

void usb_skip(void) {
    if (usb.packet_length > 0) {
        usb.packet_length = 0;
        buffer_arm(USB_DATA, OUT, USB_PACKET);
    }
}

size_t usb_read(uint8_t *bytes, size_t size) {
    size_t n = 0;
    bool ended = false;
    while (n < size && usb.packet_at < usb.packet_length && !ended) {
        bytes[n] = DPRAM(OUT_BUFFER + usb.packet_at++);
        ended = bytes[n++] == 0;
    }
    if (usb.packet_at == usb.packet_length) {
        usb_skip();
    }
    return n;
}

void usb_transmit(void) {
    uint32_t n = 0;
    uint8_t byte;
    if (usb.sending || !usb_is_open()) {
        return;
    }
    chip_hold_alarm();
    for (; n < SENT_MAX && outgoing_take(&byte); n++) {
        DPRAM(IN_BUFFER + n) = byte;
    }
    chip_release_alarm();
    if (n > 0) {
        usb.sending = true;
        buffer_arm(USB_DATA, IN, n);
    }
}

/* --- startup --- */

void usb_start(const uint8_t *uid) {
    usb_describe(uid);
    for (uint32_t at = 0; at < 0x1000u; at += 4) {
        REGISTER(USB_DPRAM + at) = 0;
    }
    REGISTER(USB_MUXING) = BIT(0) | BIT(3);  /* to the pins */
    REGISTER(USB_POWER) = BIT(2) | BIT(3);   /* no pin shows the cable's voltage to the controller */
    REGISTER(USB_MAIN_CTRL) = 1;
    REGISTER(USB_SIE_CTRL) = BIT(29);        /* control packets show in the buffers' status */
    REGISTER(USB_ENDPOINT_CONTROL(USB_NOTIFY, IN)) = USB_ENDPOINT_ENABLE | 3u << 26 | NOTIFY_BUFFER;
    REGISTER(USB_ENDPOINT_CONTROL(USB_DATA, IN)) = USB_ENDPOINT_ENABLE | 2u << 26 | IN_BUFFER;
    REGISTER(USB_ENDPOINT_CONTROL(USB_DATA, OUT)) = USB_ENDPOINT_ENABLE | 2u << 26 | OUT_BUFFER;
    SET(USB_SIE_CTRL) = BIT(16); /* pull-up: the computer sees the device */
}
