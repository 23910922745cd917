#include "protocol.h"

uint32_t crc32(const char *text, size_t length) {
    uint32_t crc = 0xFFFFFFFF;
    while (length--) {
        crc ^= (uint8_t)*text++;
        for (uint8_t bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >> 1) ^ 0xEDB88320 : crc >> 1;
    }
    return ~crc;
}

static char hex(uint8_t nibble) { return (char)(nibble < 10 ? '0' + nibble : 'A' + nibble - 10); }

/* A decimal number after one space, without sign or leading zeros; false if there is none, or it exceeds 32 bits. */
static bool take_number(const char **at, const char *end, uint32_t *number) {
    const char *p = *at;
    if (p == end || *p++ != ' ') return false;
    if (p == end || *p < '0' || *p > '9') return false;
    if (*p == '0' && p + 1 < end && p[1] >= '0' && p[1] <= '9') return false;
    uint32_t value = 0;
    for (; p < end && *p >= '0' && *p <= '9'; p++) {
        uint8_t digit = (uint8_t)(*p - '0');
        if (value > (UINT32_MAX - digit) / 10) return false;
        value = value * 10 + digit;
    }
    *number = value;
    *at = p;
    return true;
}

/* line: all of it, from '>' to before its end. */
static bool parse(const char *line, uint8_t length, struct command *command) {
    if (length < 2 + 9) return false;
    const char *end = line + length - 9; /* where '*' must be */
    if (*end != '*') return false;
    uint32_t crc = crc32(line, (size_t)(end - line));
    for (uint8_t i = 8; i; i--, crc >>= 4)
        if (end[i] != hex(crc & 15)) return false;
    struct command found = {line[1], 0, 0, 0, 0};
    const char *at = line + 2;
    switch (found.kind) {
        case COMMAND_HELLO:
            break;
        case COMMAND_ARM:
        case COMMAND_NEUTRAL:
            if (!take_number(&at, end, &found.boot) || !take_number(&at, end, &found.sequence)) return false;
            break;
        case COMMAND_DRIVE:
            if (!take_number(&at, end, &found.boot) || !take_number(&at, end, &found.sequence)) return false;
            if (!take_number(&at, end, &found.steering_us) || !take_number(&at, end, &found.throttle_us)) return false;
            break;
        default:
            return false;
    }
    if (at != end) return false;
    *command = found;
    return true;
}

enum reading reader_take(struct reader *reader, uint8_t byte, uint32_t now_ms, struct command *command) {
    if (byte == '>') {
        bool cut = reader->length > 0 || reader->noise;
        reader->line[0] = '>';
        reader->length = 1;
        reader->noise = false;
        reader->started_ms = now_ms;
        return cut ? READ_BAD : READING;
    }
    if (byte == '\n') {
        uint8_t length = reader->length;
        bool noise = reader->noise;
        reader->length = 0;
        reader->noise = false;
        if (!length) return noise ? READ_BAD : READING;
        if (now_ms - reader->started_ms > LINE_LIFETIME_MS) return READ_BAD;
        return parse(reader->line, length, command) ? READ_COMMAND : READ_BAD;
    }
    if (!reader->length) {
        reader->noise = true;
    } else if (reader->length == HOST_LINE_MAX) {
        reader->length = 0; /* the rest of it is noise */
        reader->noise = true;
    } else {
        reader->line[reader->length++] = (char)byte;
    }
    return READING;
}

void line_char(struct line *line, char c) {
    if (line->length < BOARD_LINE_MAX) line->text[line->length] = c;
    if (line->length <= BOARD_LINE_MAX) line->length++;
}

void line_text(struct line *line, const char *text) {
    line_char(line, ' ');
    while (*text) line_char(line, *text++);
}

void line_number(struct line *line, uint32_t number) {
    char digits[10];
    uint8_t n = 0;
    do digits[n++] = (char)('0' + number % 10);
    while (number /= 10);
    line_char(line, ' ');
    while (n) line_char(line, digits[--n]);
}

void line_begin(struct line *line, char kind) {
    line->length = 0;
    line_char(line, '<');
    line_char(line, kind);
}

uint8_t line_end(struct line *line) {
    if (line->length > BOARD_LINE_MAX) return 0;
    uint32_t crc = crc32(line->text, line->length);
    line_char(line, '*');
    for (int8_t shift = 28; shift >= 0; shift -= 4) line_char(line, hex((crc >> shift) & 15));
    line_char(line, '\n');
    return line->length > BOARD_LINE_MAX ? 0 : line->length;
}
