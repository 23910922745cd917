/* The firmware's own parser and state machine, fed with lines that are random, mutated, old, out of range or valid.
 *
 * Prints how many there were, and fails (exit code 1) at the first pulse that nobody asked for, or if the vehicle cannot be
 * armed and driven any more. What is allowed is known here, not taken from the code under test: the pins may do neutral,
 * the transmitter's last pulses, or the pulses of the last valid drive, and the latter two only in their state and while
 * there is a signal; and a moved steering stick ends autonomy.
 * Use: fuzz LINES SEED
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "vehicle.h"

static uint64_t random_state;
static uint32_t rnd(uint32_t below) { /* xorshift64* */
    random_state ^= random_state >> 12;
    random_state ^= random_state << 25;
    random_state ^= random_state >> 27;
    return (uint32_t)((random_state * 0x2545F4914F6CDD1DULL) >> 32) % below;
}

static struct vehicle vehicle;
static struct reader reader;
static uint32_t now_ms;
static uint16_t stick_us[2] = {STEERING_NEUTRAL_US, THROTTLE_NEUTRAL_US};
static uint16_t seen_us[2]; /* of them, the receiver's last pulses */
static uint32_t seen_ms[2];
static uint16_t rest_us;    /* the steering stick on arming */
static bool signal_on = true;
static uint32_t wanted_us[2];     /* of the last drive that must count */
static uint32_t wanted_since_ms;
static bool wanted;
static unsigned long lines, commands, driven;

static void fail(const char *what) {
    fprintf(stderr, "line %lu, %u ms: %s: state %c %c, pins %u %u, sticks %u %u, wanted %d %u %u\n", lines, now_ms, what,
            vehicle.state, vehicle.reason, vehicle.steering_us, vehicle.throttle_us, stick_us[0], stick_us[1], wanted,
            wanted_us[0], wanted_us[1]);
    exit(1);
}

static void check(void) {
    bool neutral = vehicle.steering_us == STEERING_NEUTRAL_US && vehicle.throttle_us == THROTTLE_NEUTRAL_US;
    if (!neutral && (now_ms - seen_ms[0] > 100 || now_ms - seen_ms[1] > 100)) fail("no signal, and not neutral");
    if (vehicle.state == AUTONOMOUS && abs(seen_us[0] - rest_us) > 48) fail("the human was ignored");
    if (vehicle.state == MANUAL) {
        if (!neutral && (vehicle.steering_us != seen_us[0] || vehicle.throttle_us != seen_us[1])) fail("unsafe");
    } else if (vehicle.state == AUTONOMOUS) {
        bool asked = wanted && now_ms - wanted_since_ms < 150 && vehicle.steering_us == wanted_us[0] &&
                     vehicle.throttle_us == wanted_us[1];
        if (!neutral && !asked) fail("unsafe");
        if (vehicle.steering_us < 900 || vehicle.steering_us > 2012 || vehicle.throttle_us < 120 ||
            vehicle.throttle_us > 711)
            fail("out of range");
    } else if (vehicle.state != STOPPED || !neutral) {
        fail("unsafe");
    }
}

static void pass(uint32_t ms) { /* as the sketch's loop does */
    while (ms--) {
        now_ms++;
        if (signal_on && now_ms % 21 == 0) {
            seen_us[0] = stick_us[0];
            seen_ms[0] = now_ms;
            vehicle_received(&vehicle, STEERING, seen_us[0], 21316, now_ms);
        }
        if (signal_on) {
            seen_us[1] = stick_us[1];
            seen_ms[1] = now_ms;
            vehicle_received(&vehicle, THROTTLE, seen_us[1], 1016, now_ms);
        }
        vehicle_tick(&vehicle, now_ms);
        check();
    }
}

/* genuine: what the line says if it is one that the host sent and that was not taken before. */
static void feed(const uint8_t *bytes, int length, const struct command *genuine) {
    for (int i = 0; i < length; i++) {
        struct command command;
        enum reading reading = reader_take(&reader, bytes[i], now_ms, &command);
        if (reading == READ_COMMAND) {
            commands++;
            if (command.kind == COMMAND_HELLO) continue;
            char before = vehicle.state;
            uint32_t sequence = vehicle.sequence;
            if (genuine && command.kind == COMMAND_DRIVE && before == AUTONOMOUS && command.steering_us >= 900 &&
                command.steering_us <= 2012 && command.throttle_us >= 120 && command.throttle_us <= 711) {
                wanted = true;
                wanted_us[0] = genuine->steering_us;
                wanted_us[1] = genuine->throttle_us;
                wanted_since_ms = now_ms;
            }
            vehicle_command(&vehicle, &command, now_ms);
            if (!genuine && vehicle.sequence != sequence) fail("a line that nobody sent was taken");
            if (vehicle.state == AUTONOMOUS && before != AUTONOMOUS) {
                if (!genuine || command.kind != COMMAND_ARM) fail("armed without being told");
                wanted = false;
                rest_us = seen_us[0];
            }
        }
        vehicle_tick(&vehicle, now_ms);
        check();
    }
    driven += vehicle.state == AUTONOMOUS;
    lines++;
}

static int print_command(char *text, const struct command *command) {
    int n;
    if (command->kind == COMMAND_DRIVE)
        n = sprintf(text, ">D %u %u %u %u", command->boot, command->sequence, command->steering_us, command->throttle_us);
    else
        n = sprintf(text, ">%c %u %u", command->kind, command->boot, command->sequence);
    return n + sprintf(text + n, "*%08X\n", crc32(text, (size_t)n));
}

static void still_works(void) { /* from any state at all */
    char text[128];
    reader_take(&reader, '\n', now_ms, &(struct command){0});
    signal_on = true;
    stick_us[0] = STEERING_NEUTRAL_US, stick_us[1] = THROTTLE_NEUTRAL_US;
    pass(130);
    struct command arm = {COMMAND_ARM, vehicle.boot, vehicle.sequence + 1, 0, 0};
    feed((uint8_t *)text, print_command(text, &arm), &arm);
    struct command drive = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1, 1600, 300};
    feed((uint8_t *)text, print_command(text, &drive), &drive);
    pass(1);
    if (vehicle.state != AUTONOMOUS || vehicle.steering_us != 1600 || vehicle.throttle_us != 300) fail("stuck");
}

int main(int argc, char **argv) {
    unsigned long wanted_lines = argc > 1 ? strtoul(argv[1], NULL, 10) : 1000000;
    random_state = argc > 2 ? strtoul(argv[2], NULL, 10) * 2 + 1 : 1;
    vehicle_start(&vehicle, 65535);
    static char old[64][128];
    int old_length[64] = {0};
    unsigned long kinds[8] = {0};
    while (lines < wanted_lines) {
        char text[512];
        struct command genuine = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1 + (rnd(20) ? 0 : rnd(65535)),
                                  900 + rnd(1113), 120 + rnd(592)};
        if (!rnd(12)) genuine.kind = COMMAND_ARM;
        if (!rnd(60)) genuine.kind = COMMAND_NEUTRAL;
        int length = print_command(text, &genuine);
        unsigned kind = rnd(8);
        kinds[kind]++;
        if (kind == 0) { /* random bytes, often of the protocol's own alphabet */
            static const char ALPHABET[] = "><DANQ 0123456789*ABCDEF\n";
            length = 1 + (int)rnd(100);
            bool own = rnd(2);
            for (int i = 0; i < length; i++) text[i] = own ? ALPHABET[rnd(sizeof ALPHABET - 1)] : (char)rnd(256);
            feed((uint8_t *)text, length, NULL);
        } else if (kind == 1) { /* bits flipped: a CRC-32 finds up to three in a line of this length, and longer bursts */
            char good[512];
            memcpy(good, text, sizeof good);
            for (int n = 1 + (int)rnd(3); n; n--) text[rnd((uint32_t)length)] ^= (char)(1 << rnd(8));
            feed((uint8_t *)text, length, memcmp(good, text, (size_t)length) ? NULL : &genuine);
        } else if (kind == 2) { /* cut, at either end or in the middle; the rest may come later */
            int cut = 1 + (int)rnd((uint32_t)length - 2);
            feed((uint8_t *)text, cut, NULL);
            if (rnd(2)) { /* whole after all, if it was in time */
                uint32_t late = rnd(100);
                uint32_t started = reader.started_ms;
                pass(late);
                bool in_time = now_ms - started <= LINE_LIFETIME_MS;
                feed((uint8_t *)text + cut, length - cut, in_time ? &genuine : NULL);
            }
        } else if (kind == 3) { /* replayed */
            int i = (int)rnd(64);
            if (old_length[i]) feed((uint8_t *)old[i], old_length[i], NULL);
            else lines++;
        } else if (kind == 4) { /* well-formed, and not to be obeyed */
            struct command wrong = genuine;
            switch (rnd(4)) {
                case 0: wrong.boot += 1 + rnd(1u << 31); break;
                case 1: wrong.sequence = vehicle.sequence - rnd(1u << 31); break;
                case 2: wrong.sequence = vehicle.sequence + 65536 + rnd(1u << 30); break;
                default: wrong.kind = (char)('E' + rnd(9)); /* no such command; print_command gives it two numbers */
            }
            feed((uint8_t *)text, print_command(text, &wrong), NULL);
        } else if (kind == 5) { /* out of range: taken as new, moves nothing */
            genuine.kind = COMMAND_DRIVE;
            if (rnd(2)) genuine.steering_us = rnd(2) ? rnd(900) : 2013 + rnd(1u << 31);
            else genuine.throttle_us = rnd(2) ? rnd(120) : 712 + rnd(1u << 31);
            feed((uint8_t *)text, print_command(text, &genuine), &genuine);
        } else { /* valid */
            int i = (int)rnd(64);
            feed((uint8_t *)text, length, &genuine);
            memcpy(old[i], text, (size_t)length);
            old_length[i] = length;
        }
        if (!rnd(3)) pass(rnd(40));
        if (!rnd(500)) pass(rnd(400));
        if (!rnd(300)) signal_on = !signal_on;
        if (!rnd(200)) {
            bool away = rnd(2);
            stick_us[0] = (uint16_t)(away ? 1000 + rnd(900) : STEERING_NEUTRAL_US);
            stick_us[1] = (uint16_t)(away ? 120 + rnd(800) : THROTTLE_NEUTRAL_US);
            pass(22); /* both were seen */
        }
        if (!rnd(1000)) still_works();
    }
    still_works();
    printf("%lu lines, %lu commands, %lu while autonomous; of each kind", lines, commands, driven);
    for (int i = 0; i < 8; i++) printf(" %lu", kinds[i]);
    printf("\n");
    return 0;
}
