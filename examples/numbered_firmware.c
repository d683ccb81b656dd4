// Frames for the profile "numbered" (docs/howto/boards.md), for 8 x 8 taxels.
#include <stdint.h>
#include <string.h>

enum { N = 8 * 8 };

static uint16_t crc16(const uint8_t *data, int n) {  /* CRC-16/IBM-3740 */
    uint16_t crc = 0xFFFF;
    while (n--) {
        crc ^= (uint16_t)(*data++ << 8);
        for (int k = 0; k < 8; k++) crc = (uint16_t)((crc << 1) ^ (crc & 0x8000 ? 0x1021 : 0));
    }
    return crc;
}

int frame(uint8_t *out, uint16_t number, const uint16_t *readings) {  /* of a little-endian chip */
    out[0] = 0xA5;
    out[1] = 0x5A;
    memcpy(out + 2, &number, 2);
    memcpy(out + 4, readings, 2 * N);
    uint16_t crc = crc16(out + 2, 2 + 2 * N);  /* of number and readings */
    memcpy(out + 4 + 2 * N, &crc, 2);
    return 6 + 2 * N;
}
