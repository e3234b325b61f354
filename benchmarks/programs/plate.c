/* A 5-point stencil of a heated plate, Jacobi steps in double precision.
 *
 *     gcc -O2 -o plate plate.c
 */
#include <stdio.h>

#define N 34
static double plates[2][N][N];

int main(void) {
    for (int i = 0; i < N; i++) plates[0][0][i] = plates[1][0][i] = 100.0 * i / N;
    for (int step = 0; step < 60; step++) {
        double(*from)[N] = plates[step % 2], (*to)[N] = plates[1 - step % 2];
        for (int y = 1; y < N - 1; y++)
            for (int x = 1; x < N - 1; x++)
                to[y][x] = 0.25 * (from[y][x - 1] + from[y][x + 1] + from[y - 1][x] + from[y + 1][x]);
    }
    double sum = 0.0;
    for (int y = 0; y < N; y++)
        for (int x = 0; x < N; x++) sum += y * plates[0][y][x];
    printf("%.6f\n", sum);
    for (int x = 0; x < N; x += 4) printf("%.4f ", plates[0][N / 4][x]);
    putchar('\n');
    return 0;
}
