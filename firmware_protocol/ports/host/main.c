/* board --pty LINK [--log FILE] [--limits FILE] [--script FILE] [--baud N] [--exit-when-closed SECONDS] */

#define _GNU_SOURCE

#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <libgen.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "host.h"

#define BAUD_MIN 300
#define BITS_PER_BYTE 10
#define CLOSED_MAX_S 1e9

struct options {
    const char *pty, *log, *limits, *script;
    double baud, exit_when_closed_s;
};

static double parse_number(const char *option, const char *text, double low, double high, const char *expected) {
    char *end;
    double value = strtod(text, &end);
    if (*end || end == text || !(value >= low) || value > high) {
        bad_input(option, text, expected);
    }
    return value;
}

static struct options parse(int argc, char **argv) {
    static const struct option KNOWN[] = {
        {"pty", required_argument, NULL, 'p'},    {"log", required_argument, NULL, 'l'},
        {"limits", required_argument, NULL, 'm'}, {"script", required_argument, NULL, 's'},
        {"baud", required_argument, NULL, 'b'},   {"exit-when-closed", required_argument, NULL, 'x'},
        {NULL, 0, NULL, 0},
    };
    struct options options = {.baud = 1e6, .exit_when_closed_s = -1};
    opterr = 0;
    for (int which; (which = getopt_long(argc, argv, "", KNOWN, NULL)) != -1;) {
        switch (which) {
        case 'p':
            options.pty = optarg;
            break;
        case 'l':
            options.log = optarg;
            break;
        case 'm':
            options.limits = optarg;
            break;
        case 's':
            options.script = optarg;
            break;
        case 'b':
            options.baud = parse_number("--baud", optarg, BAUD_MIN, 1e9, "at least 300");
            break;
        case 'x':
            options.exit_when_closed_s = parse_number("--exit-when-closed", optarg, 0, CLOSED_MAX_S, "a time in s");
            break;
        default:
            bad_input("options", argv[optind - 1], "--pty, --log, --limits, --script, --baud, --exit-when-closed");
        }
    }
    if (optind < argc) {
        bad_input("options", argv[optind], "no other words");
    }
    return options;
}

static void check_link(const char *link) {
    struct stat found;
    if (!link) {
        bad_input("--pty", "nothing", "a name for the link to the pty");
    }
    char *copy = strdup(link);
    if (stat(dirname(copy), &found) || !S_ISDIR(found.st_mode) || !*link) {
        bad_input("--pty", link, "a name in a folder that exists");
    }
    free(copy);
    if (lstat(link, &found) == 0 && !S_ISLNK(found.st_mode)) {
        bad_input("--pty", link, "a name that is free, or a link");
    }
}

int main(int argc, char **argv) {
    static struct port board;
    struct port *port = &board;
    struct options options = parse(argc, argv);
    check_link(options.pty);
    settings_default(&port->config);
    if (options.limits) {
        settings_read(&port->config, options.limits);
    }
    if (options.script) {
        script_read(&port->script, options.script);
    }
    port->log.fd = options.log ? open(options.log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666) : -1;
    if (options.log && port->log.fd < 0) {
        fprintf(stderr, PROGRAM ": --log %s: %s\n", options.log, strerror(errno));
        return 2;
    }
    signal(SIGPIPE, SIG_IGN);
    signal(SIGXFSZ, SIG_IGN); /* a full disk is reported as a write error of the log */
    port->line.path = options.pty;
    port->line.in.bytes_per_s = port->line.out.bytes_per_s = options.baud / BITS_PER_BYTE;
    port->exit_when_closed_us =
        options.exit_when_closed_s < 0 ? UINT64_MAX : (uint64_t)(options.exit_when_closed_s * 1e6);
    if (!line_open(&port->line)) {
        fprintf(stderr, PROGRAM ": no pty: %s\n", strerror(errno));
        return 1;
    }
    struct sched_param first = {.sched_priority = 1};
    (void)sched_setscheduler(0, SCHED_RR, &first); /* if permitted: a chip does not wait for other programs */
    port_run(port);
    if (port->log.failed) {
        fprintf(stderr, PROGRAM ": the log cannot be written (%s); the board stops with the gate off\n",
                port->log.failed);
        return 1;
    }
    return 0;
}
