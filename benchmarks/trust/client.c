/* The smallest FRI client that does its duty: the yardstick for the driver's reply latency, and one of other
 * people's clients for the emulator. Mirrors outside command mode; in command mode it superposes or sends
 * absolute positions. `sample`: as samples do that superpose a sine at full speed from its first cycle, and leave at
 * $FRI_TO_INT[1] = -1. `impedance`: a spring about the measured position of its first cycle, never mirroring. Usage: client PORT PRIORITY(0: none) CPU(-1: any) STYLE(hold|superpose|absolute|sample|impedance)
 * HANDSHAKE(stanford|ros|none) PACKETS(0: until a second of silence). Prints: received commanded */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <math.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/time.h>

#pragma pack(push, 1)
struct msr {
    uint16_t seq, refl, size, id;
    float reals[16];
    int32_t ints[16];
    uint16_t bools, fill;
    float timestamp;
    uint16_t state, quality;
    float msr_time, cmd_time, limits, rate, latency, jitter, misses;
    uint32_t missed;
    uint16_t power, control, error, warning;
    float temperature[7], position[7], cart[12], command[7], offset[7];
    float rest[142];
};
struct cmd {
    uint16_t seq, refl, size, id;
    float reals[16];
    int32_t ints[16];
    uint16_t bools, fill;
    uint32_t flags;
    float position[7], rest[51];
};
#pragma pack(pop)
_Static_assert(sizeof(struct msr) == 916, "measurement");
_Static_assert(sizeof(struct cmd) == 376, "command");

int main(int argc, char **argv) {
    if (argc != 7) return 2;
    struct sockaddr_in here = {0}, there;
    here.sin_family = AF_INET;
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    here.sin_port = htons((uint16_t)atoi(argv[1]));
    int wire = socket(AF_INET, SOCK_DGRAM, 0);
    if (bind(wire, (struct sockaddr *)&here, sizeof here)) return 3;
    struct timeval patience = {1, 0};
    setsockopt(wire, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    if (atoi(argv[2])) {
        struct sched_param priority = {.sched_priority = atoi(argv[2])};
        sched_setscheduler(0, SCHED_FIFO, &priority);
        mlockall(MCL_CURRENT | MCL_FUTURE);
    }
    if (atoi(argv[3]) >= 0) {
        cpu_set_t set;
        CPU_ZERO(&set);
        CPU_SET(atoi(argv[3]), &set);
        sched_setaffinity(0, sizeof set, &set);
    }
    int superpose = !strcmp(argv[4], "superpose"), absolute = !strcmp(argv[4], "absolute");
    int sample = !strcmp(argv[4], "sample"), impedance = !strcmp(argv[4], "impedance");
    double since = 0.0;
    int stanford = !strcmp(argv[5], "stanford"), ros = !strcmp(argv[5], "ros");
    long wanted = atol(argv[6]), received = 0, commanded = 0, patient = 120;
    struct msr msr;
    struct cmd cmd;
    memset(&cmd, 0, sizeof cmd);
    cmd.size = sizeof cmd;
    cmd.id = 0x1005;
    cmd.flags = 1;
    float begin[7] = {0};
    if (impedance) {
        cmd.flags = 0x35;
        for (int j = 0; j < 7; j++) {
            cmd.rest[25 + j] = 200.0f;
            cmd.rest[32 + j] = 0.7f;
        }
    }
    while (!wanted || received < wanted) {
        socklen_t length = sizeof there;
        ssize_t got = recvfrom(wire, &msr, sizeof msr, 0, (struct sockaddr *)&there, &length);
        if (got < 0 && !received && --patient > 0) continue;
        if (got < 0) break;
        if (got != (ssize_t)sizeof msr) continue;
        received++;
        int moves = msr.state == 2 && msr.power;
        if (!moves) commanded = 0;
        if (sample && msr.ints[0] == -1) break;
        since = moves ? since + msr.cmd_time : 0.0;
        /* One minus cosine, 0.3 Hz, from rest. */
        double shift = moves ? 0.1 * (1.0 - cos(2.0 * M_PI * 0.3 * (double)commanded * msr.cmd_time)) : 0.0;
        for (int j = 0; j < 7; j++) {
            if (moves && commanded == 0) begin[j] = msr.command[j] + msr.offset[j];
            float now = msr.command[j] + msr.offset[j];
            cmd.position[j] = now;
            if (moves && superpose) cmd.position[j] = msr.command[j] + (float)shift + (begin[j] - msr.command[j]);
            if (moves && absolute) cmd.position[j] = begin[j] + (float)shift;
            if (moves && sample) cmd.position[j] = msr.command[j] + (float)(sin(since * M_PI * 0.1) * 10.0 / 180.0 * M_PI);
            if (impedance) cmd.position[j] = moves ? begin[j] + (float)shift : msr.position[j];
            if (moves && impedance && commanded == 0) begin[j] = cmd.position[j] = msr.position[j];
            if (moves && !superpose && !absolute && !sample && !impedance) cmd.position[j] = begin[j];
        }
        if (moves) commanded++;
        if (stanford) {
            cmd.ints[14] = impedance ? 30 : 10;
            cmd.ints[15] = 10;
        }
        if (ros) {
            cmd.ints[0] = 10;
            cmd.ints[1] = 1;
        }
        cmd.seq++;
        cmd.refl = msr.seq;
        sendto(wire, &cmd, sizeof cmd, 0, (struct sockaddr *)&there, length);
    }
    printf("%ld %ld\n", received, commanded);
    return 0;
}
