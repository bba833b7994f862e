/* The sending side of a DTG head, as an example: HEAD_SAMPLE of dtg_head.dbc in portable C99.
 *
 *   dtg_head_example [--can vcan0] [--count N] [--period-us P] [--rate X Y Z] [--force X Y Z]
 *
 * Without --can the frames go to standard output as candump log lines. The head is at a constant rate (rad/s) and
 * specific force (m/s^2); put your instruments in the place of read_instruments(). Only the SocketCAN part needs Linux.
 */
#ifdef __linux__
#define _DEFAULT_SOURCE
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>
#endif

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dtg_head.h"
#include "dtg_head_e2e.h"

#define PROTOCOL 1u
#define LSB_ANGLE (1.0 / 4294967296.0) /* rad: 2^-32 */
#define LSB_DVEL (1.0 / 67108864.0)    /* m/s: 2^-26 */
#define REBALANCE_BANDWIDTH 500.0      /* 1/s: the rotor lags the case by rate / bandwidth */

enum { G1X, G1Y, G2Y, G2Z, AX, AY, AZ, CHANNELS };
enum { G1_SATURATED = 1 << 5, G2_SATURATED = 1 << 6, ACC_SATURATED = 1 << 7, ROTOR_VALID = 1 << 15 };

struct head {
    double rate[3];  /* rad/s */
    double force[3]; /* m/s^2 */
    uint32_t period_us;
    uint32_t counter;
    uint32_t time_us;
    double remainder[CHANNELS]; /* of the quantisation, in LSB */
};

/* Increments over one period and the rotor tilts at its end. */
static void read_instruments(const struct head *head, double increment[CHANNELS], double tilt[4])
{
    static const int axis[CHANNELS] = {0, 1, 1, 2, 0, 1, 2};
    const double period = head->period_us * 1e-6;
    for (int k = 0; k < CHANNELS; k++) {
        increment[k] = (k < AX ? head->rate[axis[k]] : head->force[axis[k]]) * period;
    }
    for (int k = 0; k < 4; k++) {
        tilt[k] = head->rate[axis[k]] / REBALANCE_BANDWIDTH;
    }
}

/* Round to whole LSB and keep what is left for the next sample, so that rounding adds noise but no drift. Saturation is
 * reported and its excess dropped: carried, it would come out later as a false increment. */
static int32_t quantise(double value, double lsb, double *remainder, uint16_t flag, uint16_t *status)
{
    const double exact = value / lsb + *remainder;
    const double rounded = floor(exact + 0.5);
    *remainder = 0.0;
    if (!(rounded >= INT32_MIN && rounded <= INT32_MAX)) {
        *status |= flag;
        return exact > 0.0 ? INT32_MAX : INT32_MIN;
    }
    *remainder = exact - rounded;
    return (int32_t)rounded;
}

static uint16_t crc16(uint16_t crc, uint8_t byte)
{
    crc ^= (uint16_t)(byte << 8);
    for (int bit = 0; bit < 8; bit++) {
        crc = (uint16_t)((crc << 1) ^ (crc & 0x8000u ? 0x1021u : 0u));
    }
    return crc;
}

/* AUTOSAR E2E Profile 5: bytes 2 on, then the data id, low byte first; the CRC goes to bytes 0..1, low byte first. */
static void protect_p05(uint8_t *data, size_t length, uint16_t data_id)
{
    uint16_t crc = 0xFFFFu;
    for (size_t k = 2; k < length; k++) {
        crc = crc16(crc, data[k]);
    }
    crc = crc16(crc, (uint8_t)(data_id & 0xFFu));
    crc = crc16(crc, (uint8_t)(data_id >> 8));
    data[0] = (uint8_t)(crc & 0xFFu);
    data[1] = (uint8_t)(crc >> 8);
}

static void next_sample(struct head *head, uint8_t data[DTG_HEAD_SAMPLE_LENGTH])
{
    static const uint16_t flag[CHANNELS] = {
        G1_SATURATED, G1_SATURATED, G2_SATURATED, G2_SATURATED, ACC_SATURATED, ACC_SATURATED, ACC_SATURATED};
    double increment[CHANNELS], tilt[4], unused;
    int32_t raw[CHANNELS], rotor[4];
    uint16_t status = ROTOR_VALID, rotor_status = 0;
    struct dtg_head_sample_t sample;

    read_instruments(head, increment, tilt);
    for (int k = 0; k < CHANNELS; k++) {
        raw[k] = quantise(increment[k], k < AX ? LSB_ANGLE : LSB_DVEL, &head->remainder[k], flag[k], &status);
    }
    for (int k = 0; k < 4; k++) { /* a tilt is a reading, not an increment: nothing is carried */
        unused = 0.0;
        rotor[k] = quantise(tilt[k], LSB_ANGLE, &unused, 1, &rotor_status);
    }
    if (rotor_status) {
        status &= (uint16_t)~ROTOR_VALID;
    }
    head->time_us += head->period_us; /* the clock and the counter wrap at 2^32 */

    memset(&sample, 0, sizeof sample);
    sample.e2e_counter = (uint8_t)(head->counter % DTG_HEAD_SAMPLE_E2E_COUNTER_MODULUS);
    sample.protocol = PROTOCOL;
    sample.sample_counter = head->counter++;
    sample.device_time = head->time_us;
    sample.status = status;
    sample.dtheta_g1x = raw[G1X];
    sample.dtheta_g1y = raw[G1Y];
    sample.dtheta_g2y = raw[G2Y];
    sample.dtheta_g2z = raw[G2Z];
    sample.dvel_x = raw[AX];
    sample.dvel_y = raw[AY];
    sample.dvel_z = raw[AZ];
    sample.rotor_g1x = rotor[G1X];
    sample.rotor_g1y = rotor[G1Y];
    sample.rotor_g2y = rotor[G2Y];
    sample.rotor_g2z = rotor[G2Z];
    dtg_head_sample_pack(data, &sample, DTG_HEAD_SAMPLE_LENGTH);
    protect_p05(data, DTG_HEAD_SAMPLE_LENGTH, DTG_HEAD_SAMPLE_E2E_DATA_ID);
}

static void print_frame(uint32_t time_us, const uint8_t data[DTG_HEAD_SAMPLE_LENGTH])
{
    printf("(%u.%06u) can0 %03X##1", (unsigned)(time_us / 1000000u), (unsigned)(time_us % 1000000u),
           (unsigned)DTG_HEAD_SAMPLE_FRAME_ID);
    for (size_t k = 0; k < DTG_HEAD_SAMPLE_LENGTH; k++) {
        printf("%02X", data[k]);
    }
    printf("\n");
}

#ifdef __linux__
static int open_can(const char *name)
{
    const int on = 1;
    struct ifreq request;
    struct sockaddr_can address;
    const int can = socket(PF_CAN, SOCK_RAW, CAN_RAW);

    memset(&request, 0, sizeof request);
    strncpy(request.ifr_name, name, IFNAMSIZ - 1);
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    if (can < 0 || ioctl(can, SIOCGIFINDEX, &request) < 0) {
        return -1;
    }
    address.can_ifindex = request.ifr_ifindex;
    if (setsockopt(can, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) < 0 ||
        bind(can, (struct sockaddr *)&address, sizeof address) < 0) {
        return -1;
    }
    return can;
}

static int send_frame(int can, const uint8_t data[DTG_HEAD_SAMPLE_LENGTH])
{
    struct canfd_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.can_id = DTG_HEAD_SAMPLE_FRAME_ID;
    frame.len = DTG_HEAD_SAMPLE_LENGTH;
    frame.flags = CANFD_BRS;
    memcpy(frame.data, data, DTG_HEAD_SAMPLE_LENGTH);
    return write(can, &frame, sizeof frame) == (ssize_t)sizeof frame ? 0 : -1;
}
#endif

static int usage(void)
{
    fprintf(stderr, "usage: dtg_head_example [--can vcan0] [--count N] [--period-us P] [--rate X Y Z] [--force X Y Z]\n");
    return 2;
}

int main(int argc, char **argv)
{
    struct head head = {{0.0, 0.0, 0.0}, {0.0, 0.0, -9.80665}, 1000u, 0u, 0u, {0.0}};
    const char *interface = NULL;
    unsigned long count = 1000;
    uint8_t data[DTG_HEAD_SAMPLE_LENGTH];
#ifdef __linux__
    int can = -1;
#endif

    for (int k = 1; k < argc; k++) {
        const int left = argc - k - 1;
        if (left >= 1 && !strcmp(argv[k], "--can")) {
            interface = argv[++k];
        } else if (left >= 1 && !strcmp(argv[k], "--count")) {
            count = strtoul(argv[++k], NULL, 10);
        } else if (left >= 1 && !strcmp(argv[k], "--period-us")) {
            head.period_us = (uint32_t)strtoul(argv[++k], NULL, 10);
        } else if (left >= 3 && (!strcmp(argv[k], "--rate") || !strcmp(argv[k], "--force"))) {
            double *vector = strcmp(argv[k], "--rate") ? head.force : head.rate;
            for (int i = 0; i < 3; i++) {
                vector[i] = strtod(argv[++k], NULL);
            }
        } else {
            return usage();
        }
    }
    if (interface) {
#ifdef __linux__
        can = open_can(interface);
        if (can < 0) {
            perror(interface);
            return 1;
        }
#else
        fprintf(stderr, "--can needs Linux\n");
        return 1;
#endif
    }
    while (count-- > 0) {
        next_sample(&head, data);
        if (!interface) {
            print_frame(head.time_us, data);
            continue;
        }
#ifdef __linux__
        if (send_frame(can, data) < 0) {
            perror(interface);
            return 1;
        }
        usleep(head.period_us); /* a real head is paced by its own sampling clock */
#endif
    }
    return 0;
}
