/* The firmware's own parser and state machine, fed with lines that are random, mutated, old, out of range or valid.
 *
 * Prints how many there were, and fails (exit code 1) at the first pulse that nobody asked for, or if the vehicle cannot be
 * armed and driven any more. What is allowed is known here, not taken from the code under test: the pins may do neutral,
 * the transmitter's last pulses (its throttle only after it was at rest), or go towards the pulses of the last valid
 * drive as fast and as far as the limits let them, and the latter two only in their state and while there is a signal; a
 * moved stick ends autonomy; and nothing arms without a wiggle. The board starts anew now and then, often shortly before
 * its clock or the host's sequence wraps.
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
static uint16_t rest_us[2]; /* the sticks on arming */
static bool signal_on = true;
static bool misreading;           /* some throttle pulses are measured wrongly */
static bool sides[2];             /* the steering stick was there since the last arming or loss */
static uint32_t sides_ms[2];
static unsigned at_rest, away;    /* throttle pulses in a row: at rest; not where they were on arming */
static bool throttle_may_pass;
static uint32_t wanted_us[2];     /* of the last drive that must count */
static uint32_t wanted_since_ms, wanted_heard_ms;
static bool wanted;
static uint32_t cap_us; /* as it was lowered */
static char before_state;         /* at the last check */
static uint16_t before_us[2];
static uint32_t before_ms;
static unsigned long lines, commands, driven, starts, clock_wraps, sequence_wraps;

static void fail(const char *what) {
    fprintf(stderr, "line %lu, %u ms: %s: state %c %c, pins %u %u, sticks %u %u, wanted %d %u %u\n", lines, now_ms, what,
            vehicle.state, vehicle.reason, vehicle.steering_us, vehicle.throttle_us, stick_us[0], stick_us[1], wanted,
            wanted_us[0], wanted_us[1]);
    exit(1);
}

/* On the way from where it was to what is wanted, and no further than `most` from where it was. */
static bool on_the_way(int before, int now, int wanted_there, uint32_t most) {
    int low = before < wanted_there ? before : wanted_there, high = before < wanted_there ? wanted_there : before;
    return low <= now && now <= high && (uint32_t)abs(now - before) <= most;
}

static void check(void) {
    bool neutral = vehicle.steering_us == 1456 && vehicle.throttle_us == 120;
    bool lost = now_ms - seen_ms[0] > 100 || now_ms - seen_ms[1] > 100;
    if (!neutral && lost) fail("no signal, and not neutral");
    if (lost) sides[0] = sides[1] = throttle_may_pass = false, at_rest = 0;
    if (vehicle.state == MANUAL && before_state != MANUAL) throttle_may_pass = at_rest >= 8;
    if (vehicle.state == MANUAL) {
        uint16_t throttle_us = throttle_may_pass ? seen_us[1] : 120;
        bool throttle = vehicle.throttle_us == throttle_us || vehicle.throttle_us == 120;
        if (!neutral && (vehicle.steering_us != seen_us[0] || !throttle)) fail("not the human's");
    } else if (vehicle.state == AUTONOMOUS) {
        if (abs(seen_us[0] - rest_us[0]) > 48 || away >= 5) fail("the human was ignored");
        if (!neutral && !(wanted && now_ms - wanted_since_ms < 150 && now_ms - wanted_heard_ms < 200))
            fail("nobody asked for it");
        uint32_t ms = before_state == AUTONOMOUS ? now_ms - before_ms : 0;
        int throttle_us = (int)(wanted_us[1] < cap_us ? wanted_us[1] : cap_us);
        if (!neutral && (!on_the_way(before_us[0], vehicle.steering_us, (int)wanted_us[0], 4 * ms) ||
                         !on_the_way(before_us[1], vehicle.throttle_us, throttle_us, 2 * ms)))
            fail("not what was asked for, or too fast");
        if (vehicle.steering_us < 900 || vehicle.steering_us > 2012 || vehicle.throttle_us < 120 ||
            vehicle.throttle_us > cap_us)
            fail("out of range");
    } else if (vehicle.state != STOPPED || !neutral) {
        fail("stopped, and not neutral");
    }
    before_state = vehicle.state;
    before_us[0] = vehicle.steering_us, before_us[1] = vehicle.throttle_us;
    before_ms = now_ms;
}

static void see_throttle(uint16_t us) {
    if (us >= 40 && us <= 980) { /* else it is no pulse */
        seen_us[1] = us;
        seen_ms[1] = now_ms;
        at_rest = abs(us - 120) <= 32 ? at_rest + 1 : 0;
        away = abs(us - rest_us[1]) > 32 ? away + 1 : 0;
        if (at_rest >= 8) throttle_may_pass = true;
    }
    vehicle_received(&vehicle, THROTTLE, us, 1016, now_ms);
}

static void pass(uint32_t ms) { /* as the sketch's loop does */
    while (ms--) {
        clock_wraps += !++now_ms;
        if (signal_on && now_ms % 21 == 0) {
            seen_us[0] = stick_us[0];
            seen_ms[0] = now_ms;
            for (int side = 0; side < 2; side++)
                if (side ? seen_us[0] >= 1656 : seen_us[0] <= 1256) sides[side] = true, sides_ms[side] = now_ms;
            vehicle_received(&vehicle, STEERING, seen_us[0], 21316, now_ms);
        }
        if (signal_on) see_throttle(misreading && !rnd(4) ? (uint16_t)rnd(1200) : stick_us[1]);
        vehicle_tick(&vehicle, now_ms);
        check();
    }
}

static int print_command(char *text, const struct command *command) {
    int n = sprintf(text, ">%c %u %u", command->kind, command->boot, command->sequence);
    bool drive = command->kind == COMMAND_DRIVE;
    if (drive || command->kind == COMMAND_ARM) n += sprintf(text + n, " %u", command->heard_ms);
    if (drive) n += sprintf(text + n, " %u", command->steering_us);
    if (drive || command->kind == COMMAND_LOWER) n += sprintf(text + n, " %u", command->throttle_us);
    return n + sprintf(text + n, "*%08X\n", crc32(text, (size_t)n));
}

static struct command half; /* the last line that was cut; what comes next may happen to be its end, once in 10^7 lines */
static uint32_t half_ms;

/* genuine: what the line says if it is one that the host sent and that was not taken before. */
static void feed(const uint8_t *bytes, int length, const struct command *genuine) {
    for (int i = 0; i < length; i++) {
        struct command command;
        enum reading reading = reader_take(&reader, bytes[i], now_ms, &command);
        if (reading == READ_COMMAND) {
            commands++;
            if (command.kind == COMMAND_HELLO) continue;
            char said[128], cut[128];
            print_command(said, &command), print_command(cut, &half);
            if (!genuine && now_ms - half_ms <= 50 && !strcmp(said, cut)) genuine = &half;
            char before = vehicle.state;
            uint32_t sequence = vehicle.sequence;
            if (genuine && command.kind == COMMAND_DRIVE && before == AUTONOMOUS && command.steering_us >= 900 &&
                command.steering_us <= 2012 && command.throttle_us >= 120 && command.throttle_us <= 711 &&
                now_ms - command.heard_ms <= 150) {
                wanted = true;
                wanted_us[0] = genuine->steering_us;
                wanted_us[1] = genuine->throttle_us;
                wanted_since_ms = now_ms;
                wanted_heard_ms = command.heard_ms;
            }
            if (genuine && command.kind == COMMAND_LOWER && before != AUTONOMOUS && command.throttle_us < cap_us)
                cap_us = genuine->throttle_us;
            vehicle_command(&vehicle, &command, now_ms);
            if (!genuine && vehicle.sequence != sequence) fail("a line that nobody sent was taken");
            sequence_wraps += vehicle.sequence < sequence;
            if (vehicle.state == AUTONOMOUS && before != AUTONOMOUS) {
                if (!genuine || command.kind != COMMAND_ARM) fail("armed without being told");
                for (int side = 0; side < 2; side++)
                    if (!sides[side] || now_ms - sides_ms[side] > 30000) fail("armed without a wiggle");
                sides[0] = sides[1] = wanted = false;
                rest_us[0] = seen_us[0], rest_us[1] = seen_us[1];
                away = 0;
            }
        }
        vehicle_tick(&vehicle, now_ms);
        check();
    }
    driven += vehicle.state == AUTONOMOUS;
    lines++;
}

static void wiggle(void) {
    stick_us[0] = 1150;
    pass(60);
    stick_us[0] = 1750;
    pass(60);
    stick_us[0] = 1456, stick_us[1] = 120;
    pass(300);
}

static void still_works(void) { /* from any state at all */
    char text[128];
    reader_take(&reader, '\n', now_ms, &(struct command){0});
    signal_on = true;
    misreading = false;
    wiggle();
    struct command arm = {COMMAND_ARM, vehicle.boot, vehicle.sequence + 1, now_ms, 0, 0};
    feed((uint8_t *)text, print_command(text, &arm), &arm);
    struct command drive = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1, now_ms, 1600, 200};
    feed((uint8_t *)text, print_command(text, &drive), &drive);
    pass(60);
    uint32_t throttle_us = cap_us < 200 ? cap_us : 200;
    if (vehicle.state != AUTONOMOUS || vehicle.steering_us != 1600 || vehicle.throttle_us != throttle_us) fail("stuck");
}

static void start(void) { /* a reset: of the board alone */
    vehicle_start(&vehicle, (uint16_t)(65535 + starts++));
    reader = (struct reader){0};
    now_ms = rnd(2) ? UINT32_MAX - rnd(10000) : rnd(1u << 31) * 2;
    vehicle.sequence = rnd(2) ? UINT32_MAX - rnd(300000) : rnd(1u << 31) * 2;
    seen_ms[0] = seen_ms[1] = now_ms - 1000;
    sides[0] = sides[1] = throttle_may_pass = wanted = false;
    at_rest = 0;
    cap_us = 238;
    before_state = 0;
}

int main(int argc, char **argv) {
    unsigned long wanted_lines = argc > 1 ? strtoul(argv[1], NULL, 10) : 1000000;
    random_state = argc > 2 ? strtoul(argv[2], NULL, 10) * 2 + 1 : 1;
    start();
    static char old[64][128];
    int old_length[64] = {0};
    unsigned long kinds[8] = {0};
    while (lines < wanted_lines) {
        char text[512];
        struct command genuine = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1 + (rnd(20) ? 0 : rnd(65535)),
                                  now_ms - rnd(100), 900 + rnd(1113), 120 + rnd(592)};
        if (!rnd(12)) genuine.kind = COMMAND_ARM;
        if (!rnd(60)) genuine.kind = COMMAND_NEUTRAL;
        if (!rnd(600)) genuine.kind = COMMAND_LOWER;
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
            half = genuine, half_ms = now_ms;
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
            switch (rnd(5)) {
                case 4:
                    wrong.kind = COMMAND_DRIVE;
                    wrong.heard_ms = now_ms - 151 - rnd(1u << 31);
                    break;
                case 0: wrong.boot += 1 + rnd(1u << 31); break;
                case 1: wrong.sequence = vehicle.sequence - rnd(1u << 31); break;
                case 2: wrong.sequence = vehicle.sequence + 65536 + rnd(1u << 30); break;
                default: wrong.kind = (char)('E' + rnd(7)); /* no such command; print_command gives it two numbers */
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
        if (!rnd(1000)) misreading = !misreading;
        if (!rnd(5000)) start();
        if (!rnd(60) && vehicle.state != AUTONOMOUS) wiggle();
        if (!rnd(200)) {
            bool moved = rnd(2);
            stick_us[0] = (uint16_t)(moved ? 1000 + rnd(900) : STEERING_NEUTRAL_US);
            stick_us[1] = (uint16_t)(moved ? 120 + rnd(800) : THROTTLE_NEUTRAL_US);
            pass(22); /* both were seen */
        }
        if (!rnd(1000)) still_works();
    }
    still_works();
    printf("%lu lines, %lu commands, %lu while autonomous; of each kind", lines, commands, driven);
    for (int i = 0; i < 8; i++) printf(" %lu", kinds[i]);
    printf("; %lu starts, the clock wrapped %lu times, the sequence %lu\n", starts, clock_wraps, sequence_wraps);
    return 0;
}
