/* The subset of TOML of --limits and --script: key = number, boolean or plain string, [[step]], comments. */

#include <ctype.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "host.h"

#define LINE_MAX_BYTES 256

void bad_input(const char *where, const char *value, const char *expected) {
    fprintf(stderr, PROGRAM ": %s: got %s, expected %s\n", where, value, expected);
    exit(2);
}

static _Noreturn void bad_line(const char *path, unsigned line, const char *text) {
    char where[300];
    snprintf(where, sizeof where, "%s: line %u", path, line);
    bad_input(where, *text ? text : "the end of a line", "valid TOML: key = a number, true, false or \"a word\"");
}

static char *trim(char *text) {
    while (isspace((unsigned char)*text)) {
        text++;
    }
    for (char *end = text + strlen(text); end > text && isspace((unsigned char)end[-1]);) {
        *--end = 0;
    }
    return text;
}

static void cut_comment(char *text) {
    bool quoted = false;
    for (; *text; text++) {
        if (*text == '"') {
            quoted = !quoted;
        } else if (*text == '#' && !quoted) {
            *text = 0;
            return;
        }
    }
}

static bool parse_number(struct toml_entry *entry, const char *text) {
    char digits[64], *end;
    size_t n = 0;
    for (; *text && n < sizeof digits - 1; text++) {
        if (*text != '_') {
            digits[n++] = *text;
        }
    }
    digits[n] = 0;
    if (n == 0 || strspn(digits, "0123456789+-.eE") != n || !isdigit((unsigned char)digits[n - 1])) {
        return false;
    }
    errno = 0;
    entry->number = strtod(digits, &end);
    if (*end || errno) {
        return false;
    }
    entry->kind = TOML_FLOAT;
    if (strspn(digits, "0123456789+-") == n) {
        entry->kind = TOML_INTEGER;
        entry->integer = strtoll(digits, &end, 10);
    }
    return !*end && !errno;
}

static bool parse_value(struct toml_entry *entry, const char *text) {
    size_t n = strlen(text);
    snprintf(entry->raw, sizeof entry->raw, "%.63s", text);
    if (strcmp(text, "true") == 0 || strcmp(text, "false") == 0) {
        entry->kind = TOML_BOOLEAN;
        entry->boolean = *text == 't';
        return true;
    }
    if (*text == '"') {
        entry->kind = TOML_STRING;
        if (n < 2 || n - 2 >= sizeof entry->text || text[n - 1] != '"' || memchr(text + 1, '"', n - 2) ||
            memchr(text + 1, '\\', n - 2)) {
            return false;
        }
        memcpy(entry->text, text + 1, n - 2);
        return true;
    }
    return parse_number(entry, text);
}

static bool parse_line(struct toml *toml, char *text) {
    char *equals = strchr(text, '=');
    struct toml_entry entry = {.table = toml->tables};
    if (strcmp(text, "[[step]]") == 0) {
        return ++toml->tables <= STEPS_MAX;
    }
    if (!equals || toml->count == sizeof toml->entries / sizeof toml->entries[0]) {
        return false;
    }
    *equals = 0;
    char *key = trim(text);
    size_t n = strlen(key);
    if (n == 0 || n >= sizeof entry.key || strspn(key, "abcdefghijklmnopqrstuvwxyz_0123456789") != n ||
        toml_find(toml, toml->tables, key)) {
        return false;
    }
    memcpy(entry.key, key, n);
    if (!parse_value(&entry, trim(equals + 1))) {
        return false;
    }
    toml->entries[toml->count++] = entry;
    return true;
}

void toml_read(struct toml *toml, const char *path) {
    char line[LINE_MAX_BYTES], original[LINE_MAX_BYTES];
    FILE *file = fopen(path, "r");
    toml->count = toml->tables = 0;
    if (!file) {
        bad_input(path, strerror(errno), "a readable file");
    }
    for (unsigned number = 1; fgets(line, sizeof line, file); number++) {
        cut_comment(line);
        char *text = trim(line);
        snprintf(original, sizeof original, "%s", text);
        if (*text && !parse_line(toml, text)) {
            bad_line(path, number, original);
        }
    }
    bool failed = ferror(file);
    fclose(file);
    if (failed) {
        bad_input(path, strerror(errno), "a readable file");
    }
}

const struct toml_entry *toml_find(const struct toml *toml, unsigned table, const char *key) {
    for (size_t k = 0; k < toml->count; k++) {
        if (toml->entries[k].table == table && strcmp(toml->entries[k].key, key) == 0) {
            return &toml->entries[k];
        }
    }
    return NULL;
}
