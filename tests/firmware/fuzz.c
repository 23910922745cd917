/* The firmware's own parser and state machine, fed with lines that are random, mutated, old, out of range or valid.
 *
 * Prints how many there were, and fails (exit code 1) at the first pulse that nobody asked for, or if the vehicle cannot be
 * armed and driven any more. What is allowed is known here, not taken from the code under test: the pins may do neutral,
 * the transmitter's last pulses (its throttle only after it was at rest), or go towards the pulses of the last valid
 * drive as fast and as far as the limits let them, and the latter two only in their state and while there is a signal; a
 * moved stick ends autonomy; and nothing arms without a wiggle, nor long after it was asked for. The board starts anew now and then, often shortly before
 * its clock or the host's sequence wraps, and as another car; other cars are told too, some of which may not be.
 * With HUMAN_GAMEPAD the human's pulses come as lines as well: they count from when their host heard the board, if that is
 * newer than before, and get the host's cap.
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
/* Of steering and of throttle period, least, neutral, most; and the cap. The first is what nobody needs to tell. */
static const uint16_t CARS[][9] = {
    {21316, 900, 1456, 2012, 1016, 120, 120, 711, 118},
    {20000, 1000, 1500, 2000, 20000, 1000, 1500, 2000, 100},
    {20000, 1100, 1480, 1900, 14000, 1000, 1000, 2000, 60},
    {3003, 1050, 1550, 2100, 1010, 100, 100, 500, 80},
    {21316, 950, 1500, 2050, 1010, 130, 130, 711, 90}, /* its transmitter may be the first's */
    {21316, 950, 1500, 2050, 1010, 160, 160, 711, 118},
};
enum { CAR_COUNT = sizeof CARS / sizeof *CARS };
/* And some that may not be: each differs in one number from the one above of the same index modulo four. */
static const uint16_t BAD_CARS[][9] = {
    {21316, 900, 1456, 2012, 1016, 120, 120, 711, 119},
    {20000, 1000, 1500, 2000, 20000, 700, 1500, 2000, 100},
    {20000, 1100, 1480, 1729, 14000, 1000, 1000, 2000, 60},
    {3003, 1050, 1550, 2100, 1010, 50, 100, 500, 80},
    {21316, 900, 2012, 2012, 1016, 120, 120, 711, 118},
    {2000, 1000, 1500, 2000, 20000, 1000, 1500, 2000, 100},
    {20000, 1100, 1480, 1900, 14000, 1000, 2000, 2000, 60},
    {3003, 1050, 1550, 2100, 1010, 100, 100, 712, 80},
    {21316, 900, 1456, 2012, 1016, 170, 170, 711, 118},
    {20000, 1000, 1500, 2000, 20000, 1000, 1500, 2000, 0},
};
static const uint16_t *car = CARS[0];
static bool told = true; /* or it is the first */
static bool fast(void) { return car[4] < 3000; }
#ifdef HUMAN_GAMEPAD
enum { GAMEPAD = true, LOST_MS = 150 };
#else
enum { GAMEPAD = false, LOST_MS = 100 };
#endif
static uint32_t sticks_ms; /* of the status that the gamepad's last line answered */
static uint32_t id_of(const uint16_t *numbers) { return crc32((const char *)numbers, 18); }
static uint16_t stick_us[2] = {1456, 120};
static uint16_t seen_us[2]; /* of them, the receiver's last pulses */
static uint32_t seen_ms[2], seen_before_ms[2]; /* of the last pulse, and of the one before */
static uint16_t rest_us[2]; /* the sticks on arming */
static bool signal_on = true;
static bool misreading;           /* some throttle pulses are measured wrongly; of a gamepad: its host sends no lines */
static bool sides[2], wiggled;    /* the steering stick was there, with the throttle at rest since, and no arming or loss */
static uint32_t sides_ms[2], wiggled_ms;
static void forget_wiggle(void) { sides[0] = sides[1] = wiggled = false; }
static unsigned at_rest, away;    /* throttle pulses in a row: at rest; not where they were on arming */
static bool throttle_may_pass;
static bool awaited[2];           /* a signal is not there before two of its pulses within LOST_MS */
static uint32_t wanted_us[2];     /* of the last drive that must count */
static uint32_t wanted_since_ms, wanted_heard_ms;
static bool wanted;
static uint32_t lowered_us; /* the cap, as it was lowered */
static uint32_t cap_us(void) { return lowered_us < car[8] ? lowered_us : car[8]; }
static char before_state;         /* at the last check */
static uint16_t before_us[2];
static uint32_t before_ms;
static unsigned long lines, commands, driven, starts, clock_wraps, sequence_wraps, cars;

static void fail(const char *what) {
    fprintf(stderr, "line %lu, %u ms: %s: state %c %c, pins %u %u, sticks %u %u, wanted %d %u %u\n", lines, now_ms, what,
            vehicle.state, vehicle.reason, vehicle.steering_us, vehicle.throttle_us, stick_us[0], stick_us[1], wanted,
            wanted_us[0], wanted_us[1]);
    exit(1);
}

static bool is_throttle(uint32_t us) { return fast() ? us >= 40 && us <= 980 : us >= 800 && us <= 2200; }

/* What the pins get of the human's throttle: of a gamepad's no more than of the host's. */
static uint16_t passed_us(uint16_t us) {
    int least_us = car[6] - (int)cap_us(), most_us = car[6] + (int)cap_us();
    if (!GAMEPAD) return us;
    if (least_us < car[5]) least_us = car[5];
    if (most_us > car[7]) most_us = car[7];
    return (uint16_t)(us < least_us ? least_us : us > most_us ? most_us : us);
}

/* On the way from where it was to what is wanted, and no further than `most` from where it was. */
static bool on_the_way(int before, int now, int wanted_there, uint32_t most) {
    int low = before < wanted_there ? before : wanted_there, high = before < wanted_there ? wanted_there : before;
    return low <= now && now <= high && (uint32_t)abs(now - before) <= most;
}

static void check(void) {
    bool neutral = vehicle.steering_us == car[2] && vehicle.throttle_us == car[6];
    for (int i = 0; i < 2; i++) { /* pulses of the other count while it is awaited, its own from before do not */
        bool old = now_ms - seen_before_ms[i] > LOST_MS;
        if (old && !awaited[i]) at_rest = 0, seen_ms[i] = now_ms - 1000;
        awaited[i] = old;
    }
    bool lost = now_ms - seen_ms[0] > LOST_MS || now_ms - seen_ms[1] > LOST_MS;
    if (!neutral && lost) fail("no signal, and not neutral");
    if (lost) forget_wiggle();
    if (lost) throttle_may_pass = false;
    if (vehicle.state == MANUAL && before_state != MANUAL) throttle_may_pass = at_rest >= 8;
    if (vehicle.state == MANUAL) {
        uint16_t throttle_us = throttle_may_pass ? passed_us(seen_us[1]) : car[6];
        bool throttle = vehicle.throttle_us == throttle_us || vehicle.throttle_us == car[6];
        if (!neutral && (vehicle.steering_us != seen_us[0] || !throttle)) fail("not the human's");
    } else if (vehicle.state == AUTONOMOUS) {
        if (abs(seen_us[0] - rest_us[0]) > 48 || away >= (fast() && !GAMEPAD ? 5 : 1)) fail("the human was ignored");
        if (!neutral && !(wanted && now_ms - wanted_since_ms < 150 && now_ms - wanted_heard_ms < 200))
            fail("nobody asked for it");
        uint32_t ms = before_state == AUTONOMOUS ? now_ms - before_ms : 0;
        int least_us = car[6] - (int)cap_us(), most_us = car[6] + (int)cap_us(), throttle_us = (int)wanted_us[1];
        throttle_us = throttle_us < least_us ? least_us : throttle_us > most_us ? most_us : throttle_us;
        if (!neutral && (!on_the_way(before_us[0], vehicle.steering_us, (int)wanted_us[0], 4 * ms) ||
                         !on_the_way(before_us[1], vehicle.throttle_us, throttle_us, 2 * ms)))
            fail("not what was asked for, or too fast");
        if (vehicle.steering_us < car[1] || vehicle.steering_us > car[3] || vehicle.throttle_us < car[5] ||
            vehicle.throttle_us > car[7] || vehicle.throttle_us < least_us || vehicle.throttle_us > most_us)
            fail("out of range");
    } else if (vehicle.state != STOPPED || !neutral) {
        fail("stopped, and not neutral");
    }
    before_state = vehicle.state;
    before_us[0] = vehicle.steering_us, before_us[1] = vehicle.throttle_us;
    before_ms = now_ms;
}

static void see_steering(uint16_t us, uint32_t at_ms) {
    seen_us[0] = us;
    seen_before_ms[0] = seen_ms[0], seen_ms[0] = at_ms;
    for (int side = 0; side < 2; side++)
        if (side ? us >= car[2] + 200 : us <= car[2] - 200) {
            sides[side] = true, sides_ms[side] = at_ms;
            if (sides[!side] && at_ms - sides_ms[!side] <= 3000) wiggled = true, wiggled_ms = at_ms;
        }
}

static void see_throttle(uint16_t us, uint32_t at_ms) {
    if (is_throttle(us)) {
        seen_us[1] = us;
        seen_before_ms[1] = seen_ms[1], seen_ms[1] = at_ms;
        at_rest = abs(us - car[6]) <= 32 ? at_rest + 1 : 0;
        if (!at_rest) forget_wiggle();
        away = abs(us - rest_us[1]) > 32 ? away + 1 : 0;
        if (at_rest >= 8) throttle_may_pass = true;
    }
}

/* A gamepad's line that the host sent, and that the board must take if it is newer than the last and in range. */
static void see_sticks(const struct command *sticks) {
    uint32_t at_ms = sticks->heard_ms;
    if (now_ms - at_ms > LOST_MS || now_ms - at_ms >= now_ms - sticks_ms) return;
    if (!sticks->steering_us && !sticks->throttle_us) {
        sticks_ms = at_ms;
        for (int i = 0; i < 2; i++) seen_ms[i] = seen_before_ms[i] = now_ms - 1000, awaited[i] = true;
        forget_wiggle();
        throttle_may_pass = false, at_rest = 0;
        return;
    }
    uint32_t steering_us = sticks->steering_us, throttle_us = sticks->throttle_us;
    if (steering_us < car[1] || steering_us > car[3] || !is_throttle(throttle_us)) return;
    sticks_ms = at_ms;
    see_steering((uint16_t)steering_us, at_ms);
    see_throttle((uint16_t)throttle_us, at_ms);
}

static void relay(void);

static void pass(uint32_t ms) { /* as the sketch's loop does */
    while (ms--) {
        clock_wraps += !++now_ms;
        if (GAMEPAD && !misreading && now_ms % 20 == 0) relay();
        if (!GAMEPAD && signal_on && now_ms % 21 == 0) {
            see_steering(stick_us[0], now_ms);
            vehicle_received(&vehicle, STEERING, seen_us[0], car[0], now_ms);
        }
        if (!GAMEPAD && signal_on && (fast() || now_ms % 20 == 0)) {
            uint16_t us = misreading && !rnd(4) ? (uint16_t)rnd(fast() ? 1200 : 2600) : stick_us[1];
            see_throttle(us, now_ms);
            vehicle_received(&vehicle, THROTTLE, us, car[4], now_ms);
        }
        vehicle_tick(&vehicle, now_ms);
        check();
    }
}

static int print_command(char *text, const struct command *command) {
    bool drive = command->kind == COMMAND_DRIVE, sticks = command->kind == COMMAND_STICKS;
    int n = sprintf(text, ">%c %u %u", command->kind, command->boot, sticks ? command->heard_ms : command->sequence);
    if (drive || command->kind == COMMAND_ARM) n += sprintf(text + n, " %u", command->heard_ms);
    if (command->kind == COMMAND_ARM) n += sprintf(text + n, " %u %u", command->asked_ms, command->car);
    for (int i = 0; command->kind == COMMAND_CAR && i < 9; i++) n += sprintf(text + n, " %u", command->numbers[i]);
    if (drive || sticks) n += sprintf(text + n, " %u", command->steering_us);
    if (drive || sticks || command->kind == COMMAND_LOWER) n += sprintf(text + n, " %u", command->throttle_us);
    return n + sprintf(text + n, "*%08X\n", crc32(text, (size_t)n));
}

static struct command half; /* the last line that was cut; what comes next may happen to be its end, once in 10^7 lines */
static uint32_t half_ms;

static void let_go(void) { stick_us[0] = car[2], stick_us[1] = car[6]; }

/* What the pins do, and what counts as a pulse, is another car's from here on; signals that are this car's too stay. */
static void drives(const uint16_t *other) {
    if (other == car) return;
    for (int i = 0; i < 2; i++) {
        bool lets_slow = seen_us[i] >= 800 && seen_us[i] <= 2200, lets_fast = seen_us[i] >= 40 && seen_us[i] <= 980;
        bool stays = 4 * abs(car[4 * i] - other[4 * i]) <= other[4 * i] && (other[4 * i] < 3000 ? lets_fast : lets_slow);
        if (!stays) seen_ms[i] = seen_before_ms[i] = now_ms - 1000;
    }
    car = other;
    forget_wiggle();
    if (abs(seen_us[1] - car[6]) > 32) throttle_may_pass = false, at_rest = 0;
    let_go();
}

/* genuine: what the line says if it is one that the host sent and that was not taken before. */
static void take(const uint8_t *bytes, int length, const struct command *genuine) {
    for (int i = 0; i < length; i++) {
        struct command command;
        enum reading reading = reader_take(&reader, bytes[i], now_ms, &command);
        if (reading == READ_COMMAND) {
            commands++;
            if (command.kind == COMMAND_HELLO) continue;
            char said[160], cut[160];
            print_command(said, &command), print_command(cut, &half);
            if (!genuine && now_ms - half_ms <= 50 && !strcmp(said, cut)) genuine = &half;
            if (genuine && command.kind == COMMAND_STICKS) see_sticks(&command);
            char before = vehicle.state;
            uint32_t sequence = vehicle.sequence;
            if (genuine && command.kind == COMMAND_DRIVE && before == AUTONOMOUS &&
                command.steering_us >= car[1] && command.steering_us <= car[3] && command.throttle_us >= car[5] &&
                command.throttle_us <= car[7] && now_ms - command.heard_ms <= 150) {
                wanted = true;
                wanted_us[0] = genuine->steering_us;
                wanted_us[1] = genuine->throttle_us;
                wanted_since_ms = now_ms;
                wanted_heard_ms = command.heard_ms;
            }
            uint32_t lowered = (uint32_t)abs((int)command.throttle_us - car[6]);
            if (genuine && command.kind == COMMAND_LOWER && before != AUTONOMOUS && command.throttle_us >= car[5] &&
                command.throttle_us <= car[7] && lowered < cap_us())
                lowered_us = lowered;
            vehicle_command(&vehicle, &command, now_ms);
            if (!genuine && vehicle.sequence != sequence) fail("a line that nobody sent was taken");
            if (genuine && command.kind == COMMAND_CAR && before != AUTONOMOUS && vehicle.result != 't')
                for (int i = 0; i < CAR_COUNT; i++)
                    if (!memcmp(command.numbers, CARS[i], 18)) told = true, drives(CARS[i]), cars++;
            sequence_wraps += vehicle.sequence < sequence;
            if (vehicle.state == AUTONOMOUS && before != AUTONOMOUS) {
                if (!genuine || command.kind != COMMAND_ARM) fail("armed without being told");
                if (!told || command.car != id_of(car)) fail("armed for another car");
                if (!wiggled || now_ms - wiggled_ms > 30000 || now_ms - wiggled_ms < 1000) fail("armed without a wiggle");
                if (now_ms - command.asked_ms > 31000) fail("armed long after it was asked for");
                forget_wiggle();
                wanted = false;
                rest_us[0] = seen_us[0], rest_us[1] = seen_us[1];
                away = 0;
            }
        }
        vehicle_tick(&vehicle, now_ms);
        check();
    }
}

static void feed(const uint8_t *bytes, int length, const struct command *genuine) {
    take(bytes, length, genuine);
    driven += vehicle.state == AUTONOMOUS;
    lines++;
}

/* What the gamepad does now: the sticks, or 0 and 0. */
static void relay(void) {
    struct command sticks = {COMMAND_STICKS, vehicle.boot, 0, now_ms - rnd(15), signal_on ? stick_us[0] : 0u,
                             signal_on ? stick_us[1] : 0u, 0, 0, {0}};
    char text[160];
    take((uint8_t *)text, print_command(text, &sticks), &sticks);
}

static void wiggle(void) {
    stick_us[0] = 1150;
    pass(60);
    stick_us[0] = 1750;
    pass(60);
    let_go();
    pass(rnd(4) ? 1050 : 300);
}

static void still_works(void) { /* from any state at all */
    char text[160];
    reader_take(&reader, '\n', now_ms, &(struct command){0});
    signal_on = true;
    misreading = false;
    struct command tell = {COMMAND_CAR, vehicle.boot, vehicle.sequence + 1, 0, 0, 0, 0, 0, {0}};
    memcpy(tell.numbers, car, sizeof tell.numbers);
    let_go();
    pass(200);
    feed((uint8_t *)text, print_command(text, &tell), &tell);
    wiggle();
    pass(1050);
    struct command arm = {COMMAND_ARM, vehicle.boot, vehicle.sequence + 1, now_ms, 0, 0, now_ms, id_of(car), {0}};
    feed((uint8_t *)text, print_command(text, &arm), &arm);
    struct command drive = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1, now_ms, car[2] + 144u, car[6] + 80u, 0, 0, {0}};
    feed((uint8_t *)text, print_command(text, &drive), &drive);
    pass(60);
    uint32_t throttle_us = car[6] + (cap_us() < 80 ? cap_us() : 80);
    if (vehicle.state != AUTONOMOUS || vehicle.steering_us != car[2] + 144 || vehicle.throttle_us != throttle_us) fail("stuck");
}

static void start(void) { /* a reset: of the board alone */
    if (rnd(2)) drives(CARS[0]); /* else it has kept its car, and must be told again */
    told = car == CARS[0];
    struct car kept;
    memcpy(&kept, car, sizeof kept);
    vehicle_start(&vehicle, (uint16_t)(65535 + starts++), &kept);
    reader = (struct reader){0};
    now_ms = rnd(2) ? UINT32_MAX - rnd(10000) : rnd(1u << 31) * 2;
    vehicle.sequence = rnd(2) ? UINT32_MAX - rnd(300000) : rnd(1u << 31) * 2;
    seen_ms[0] = seen_ms[1] = seen_before_ms[0] = seen_before_ms[1] = now_ms - 1000;
    awaited[0] = awaited[1] = true;
    forget_wiggle();
    throttle_may_pass = wanted = false;
    at_rest = 0;
    sticks_ms = 0;
    lowered_us = UINT32_MAX;
    before_state = 0;
}

int main(int argc, char **argv) {
    unsigned long wanted_lines = argc > 1 ? strtoul(argv[1], NULL, 10) : 1000000;
    random_state = argc > 2 ? strtoul(argv[2], NULL, 10) * 2 + 1 : 1;
    start();
    static char old[64][160];
    int old_length[64] = {0};
    unsigned long kinds[8] = {0};
    while (lines < wanted_lines) {
        char text[512];
        struct command genuine = {COMMAND_DRIVE, vehicle.boot, vehicle.sequence + 1 + (rnd(20) ? 0 : rnd(65535)),
                                  now_ms - rnd(100), car[1] + rnd(car[3] - car[1] + 1u),
                                  car[5] + rnd(car[7] - car[5] + 1u), now_ms - rnd(32000), id_of(car), {0}};
        if (!rnd(12)) genuine.kind = COMMAND_ARM;
        if (!rnd(60)) genuine.kind = COMMAND_NEUTRAL;
        if (!rnd(600)) genuine.kind = COMMAND_LOWER;
        if (!rnd(300)) {
            genuine.kind = COMMAND_CAR;
            memcpy(genuine.numbers, rnd(4) ? CARS[rnd(CAR_COUNT)] : BAD_CARS[rnd(sizeof BAD_CARS / sizeof *BAD_CARS)], 18);
        }
        if (GAMEPAD && !rnd(30)) genuine.kind = COMMAND_STICKS, genuine.heard_ms = now_ms - rnd(300);
        if (!rnd(40)) genuine.car = id_of(CARS[rnd(CAR_COUNT)]);
        int length = print_command(text, &genuine);
        unsigned kind = rnd(8);
        kinds[kind]++;
        if (kind == 0) { /* random bytes, often of the protocol's own alphabet */
            static const char ALPHABET[] = "><DANQCS 0123456789*ABCDEF\n";
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
            switch (wrong.kind == COMMAND_STICKS ? 0 : rnd(5)) {
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
            if (rnd(2)) genuine.steering_us = rnd(2) ? rnd(car[1]) : car[3] + 1 + rnd(1u << 31);
            else genuine.throttle_us = rnd(2) ? rnd(car[5]) : car[7] + 1 + rnd(1u << 31);
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
        if (!rnd(20) && vehicle.state != AUTONOMOUS) wiggle();
        if (!rnd(200)) {
            bool moved = rnd(2);
            let_go();
            if (moved) stick_us[0] = (uint16_t)(1000 + rnd(900));
            if (moved) stick_us[1] = (uint16_t)(fast() ? 120 + rnd(800) : 1000 + rnd(1000));
            pass(22); /* both were seen */
        }
        if (!rnd(1000)) still_works();
    }
    still_works();
    printf("%lu lines, %lu commands, %lu while autonomous; of each kind", lines, commands, driven);
    for (int i = 0; i < 8; i++) printf(" %lu", kinds[i]);
    printf("; %lu starts, the clock wrapped %lu times, the sequence %lu; %lu cars told\n", starts, clock_wraps,
           sequence_wraps, cars);
    return 0;
}
