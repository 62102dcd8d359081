/* The kernel's side of an input device for one process: answers its ioctls from a file, while events come through a
 * pseudo-terminal. Loaded by LD_PRELOAD. The file's layout is that of `struct film`; its writer is emulated_film.py. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/input.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <unistd.h>

#define SLOTS_MAX 16

struct film {
    int32_t has_slots, clock, slots, current;
    int32_t x[3], y[3]; /* minimum, maximum, resolution */
    int32_t state[3][SLOTS_MAX]; /* tracking id, x, y */
};

static struct film *open_film(void) {
    static struct film *film;
    if (!film) {
        int fd = open(getenv("EMULATED_FILM"), O_RDWR);
        film = mmap(NULL, sizeof *film, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
        close(fd);
    }
    return film;
}

static int fail(int error) {
    errno = error;
    return -1;
}

static void set_bit(uint8_t *bits, unsigned size, unsigned bit) {
    if (bit / 8 < size) bits[bit / 8] |= 1 << bit % 8;
}

static int list_codes(struct film *film, unsigned kind, unsigned size, uint8_t *bits) {
    memset(bits, 0, size);
    if (kind == 0) {
        set_bit(bits, size, EV_SYN);
        set_bit(bits, size, EV_ABS);
    } else if (kind == EV_ABS) {
        set_bit(bits, size, ABS_X);
        if (film->has_slots)
            for (unsigned i = 0; i < 4; i++)
                set_bit(bits, size,
                        (unsigned[]){ABS_MT_SLOT, ABS_MT_TRACKING_ID, ABS_MT_POSITION_X, ABS_MT_POSITION_Y}[i]);
    }
    return (int)size;
}

static int describe_axis(struct film *film, unsigned code, struct input_absinfo *info) {
    memset(info, 0, sizeof *info);
    if (code == ABS_MT_SLOT) {
        info->value = film->current;
        info->maximum = film->slots - 1;
    } else {
        int32_t *axis = code == ABS_MT_POSITION_Y ? film->y : film->x;
        info->minimum = axis[0];
        info->maximum = axis[1];
        info->resolution = axis[2];
    }
    return 0;
}

struct slots_request {
    uint32_t code;
    int32_t values[];
};

static int state_slots(struct film *film, unsigned size, struct slots_request *request) {
    static const unsigned codes[3] = {ABS_MT_TRACKING_ID, ABS_MT_POSITION_X, ABS_MT_POSITION_Y};
    for (unsigned i = 0; i < 3; i++)
        if (request->code == codes[i]) {
            unsigned count = (size - sizeof(uint32_t)) / sizeof(int32_t);
            for (unsigned slot = 0; slot < count && slot < (unsigned)film->slots; slot++)
                request->values[slot] = film->state[i][slot];
            return 0;
        }
    return fail(EINVAL);
}

int ioctl(int fd, unsigned long request, ...) {
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (_IOC_TYPE(request) != 'E') {
        int (*next)(int, unsigned long, ...) = (int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl");
        return next(fd, request, argument);
    }
    struct film *film = open_film();
    unsigned size = _IOC_SIZE(request), number = _IOC_NR(request);
    if (request == EVIOCGVERSION) return *(int *)argument = EV_VERSION, 0;
    if (request == EVIOCGID) return memset(argument, 0, size), 0;
    if (request == EVIOCGEFFECTS) return *(int *)argument = 0, 0;
    if (request == EVIOCSCLOCKID) return film->clock = *(int *)argument, 0;
    if (request == EVIOCGNAME(size)) return strncpy(argument, "Emulated film", size), 14;
    if (request == EVIOCGMTSLOTS(size)) return state_slots(film, size, argument);
    for (unsigned kind = 0; kind < EV_CNT; kind++)
        if (request == EVIOCGBIT(kind, size)) return list_codes(film, kind, size, argument);
    if (number >= 0x40 && number < 0x80 && request == EVIOCGABS(number - 0x40))
        return describe_axis(film, number - 0x40, argument);
    return fail(ENOTTY);
}
