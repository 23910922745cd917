/* The lines that the host and the Arduino exchange: ../README.md has them in one table. Plain C, no Arduino. */
#ifndef ROVER_PROTOCOL_H
#define ROVER_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PROTOCOL_VERSION 4
/* rover_lib/onboard/car/servo_link.py drives no other: change both. */
#ifdef HUMAN_GAMEPAD
#define FIRMWARE_VERSION "4.2.0-gamepad"
#else
#define FIRMWARE_VERSION "4.2.0"
#endif

enum {
    HOST_LINE_MAX = 87,     /* the longest line of the host without its end: two numbers of ten digits, nine of five */
    BOARD_LINE_MAX = 127,   /* the longest line of the Arduino, its end included */
    LINE_LIFETIME_MS = 50,  /* a line whose end comes later than this after its start is stale: 87 characters take 8 ms */
    CAR_NUMBERS = 9
};

enum command_kind {
    COMMAND_HELLO = 'Q',
    COMMAND_ARM = 'A',
    COMMAND_DRIVE = 'D',
    COMMAND_NEUTRAL = 'N',
    COMMAND_LOWER = 'L', /* the throttle's cap */
    COMMAND_CAR = 'C',
    COMMAND_STICKS = 'S' /* a gamepad's; only with HUMAN_GAMEPAD, of a board without a receiver */
};

struct command {
    char kind;
    uint32_t boot, sequence;           /* not in COMMAND_HELLO; COMMAND_STICKS has no sequence */
    uint32_t heard_ms;                 /* in COMMAND_ARM, _DRIVE, _STICKS: time of the newest status that the host read */
    uint32_t steering_us, throttle_us; /* in COMMAND_DRIVE, _STICKS, the throttle in COMMAND_LOWER; vehicle.c checks them */
    uint32_t asked_ms;                 /* in COMMAND_ARM: heard_ms as it was when somebody asked to arm the car */
    uint32_t car;                      /* in COMMAND_ARM: which one the host means */
    uint16_t numbers[CAR_NUMBERS];     /* in COMMAND_CAR: the car, in the order of struct car */
};

enum reading { READING, READ_COMMAND, READ_BAD };

struct reader {
    char line[HOST_LINE_MAX];
    uint8_t length;       /* 0: waiting for a '>' */
    bool noise;           /* since the last end of a line, bytes came that belong to no line */
    uint32_t started_ms;
};

/* CRC-32 of Ethernet, zip and PNG (reflected 0xEDB88320, start and final value 0xFFFFFFFF): zlib.crc32 in Python. */
uint32_t crc32(const char *text, size_t length);

/* Takes one byte. READ_COMMAND once per whole, fresh, well-formed line, which is then in *command; READ_BAD once per
 * line that is not; READING in between. Any bytes at all may be given, and a '>' always starts a new line. */
enum reading reader_take(struct reader *reader, uint8_t byte, uint32_t now_ms, struct command *command);

/* A line of the Arduino, built from its parts. If they do not fit, line_end returns 0 and there is no line to send. */
struct line {
    char text[BOARD_LINE_MAX + 1];
    uint8_t length; /* more than BOARD_LINE_MAX: the line did not fit */
};

void line_begin(struct line *line, char kind);
void line_text(struct line *line, const char *text);
void line_char(struct line *line, char c);
void line_number(struct line *line, uint32_t number);
uint8_t line_end(struct line *line);

#ifdef __cplusplus
}
#endif
#endif
