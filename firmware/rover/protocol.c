#include "protocol.h"

uint32_t crc32(const char *text, size_t length) {
    /* Half a byte at a time, because bit by bit a status took half of the loop's time. */
    static const uint32_t OF_NIBBLE[16] = {
        0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
        0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
    };
    uint32_t crc = 0xFFFFFFFF;
    while (length--) {
        crc ^= (uint8_t)*text++;
        crc = (crc >> 4) ^ OF_NIBBLE[crc & 15];
        crc = (crc >> 4) ^ OF_NIBBLE[crc & 15];
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
        if (value > UINT32_MAX / 10 || (value == UINT32_MAX / 10 && digit > UINT32_MAX % 10)) return false;
        value = value * 10 + digit;
    }
    *number = value;
    *at = p;
    return true;
}

/* line: the whole line, from '>' on, without its line feed. */
static bool parse(const char *line, uint8_t length, struct command *command) {
    if (length < 2 + 9) return false;
    const char *end = line + length - 9; /* where '*' must be */
    if (*end != '*') return false;
    uint32_t crc = crc32(line, (size_t)(end - line));
    for (uint8_t i = 8; i; i--, crc >>= 4)
        if (end[i] != hex(crc & 15)) return false;
    struct command found = {line[1], 0, 0, 0, 0, 0, 0, 0, {0}};
    uint32_t *numbers[5] = {&found.boot, &found.sequence};
    uint8_t count = 2, shorts = 0;
    switch (found.kind) {
        case COMMAND_HELLO:
            count = 0;
            break;
        case COMMAND_NEUTRAL:
            break;
        case COMMAND_ARM:
            numbers[count++] = &found.heard_ms;
            numbers[count++] = &found.asked_ms;
            numbers[count++] = &found.car;
            break;
        case COMMAND_CAR:
            shorts = CAR_NUMBERS;
            break;
        case COMMAND_LOWER:
            numbers[count++] = &found.throttle_us;
            break;
#ifdef HUMAN_GAMEPAD
        case COMMAND_STICKS:
            numbers[1] = &found.heard_ms;
            numbers[count++] = &found.steering_us;
            numbers[count++] = &found.throttle_us;
            break;
#endif
        case COMMAND_DRIVE:
            numbers[count++] = &found.heard_ms;
            numbers[count++] = &found.steering_us;
            numbers[count++] = &found.throttle_us;
            break;
        default:
            return false;
    }
    const char *at = line + 2;
    for (uint8_t i = 0; i < count; i++)
        if (!take_number(&at, end, numbers[i])) return false;
    for (uint8_t i = 0; i < shorts; i++) {
        uint32_t number;
        if (!take_number(&at, end, &number) || number > UINT16_MAX) return false;
        found.numbers[i] = (uint16_t)number;
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
    /* By subtraction, because a 32-bit division takes the chip 40 us, and a status has 60 digits. */
    static const uint32_t POWERS[] = {1000000000, 100000000, 10000000, 1000000, 100000, 10000, 1000, 100, 10};
    bool begun = false;
    line_char(line, ' ');
    for (uint8_t i = 0; i < sizeof POWERS / sizeof *POWERS; i++) {
        char digit = '0';
        for (; number >= POWERS[i]; number -= POWERS[i]) digit++;
        begun = begun || digit > '0';
        if (begun) line_char(line, digit);
    }
    line_char(line, (char)('0' + number));
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
