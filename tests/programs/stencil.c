/* Vectors: heat on a plate until it settles, and a product of matrices, in SSE2 code of gcc.
 *
 *     gcc -O3 -msse2 -fassociative-math -fno-signed-zeros -fno-trapping-math -Wl,-z,now -o stencil stencil.c
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { ROWS = 60, COLUMNS = 60, SIZE = 96, MOST_SWEEPS = 2000 };

static double *cells(int count) {
    double *made = calloc((size_t) count + 1, sizeof *made);
    if (made == NULL) {
        fprintf(stderr, "out of memory\n");
        exit(1);
    }
    return made + 1; /* not aligned to a vector, as a plate's interior is not */
}

__attribute__((noinline)) static double sweep(const double *restrict old, double *restrict new) {
    double change = 0.0;
    for (int row = 1; row < ROWS - 1; row++) {
        const double *here = old + row * COLUMNS;
        double *into = new + row * COLUMNS;
        for (int column = 1; column < COLUMNS - 1; column++) {
            double around = here[column - 1] + here[column + 1] + here[column - COLUMNS] +
                            here[column + COLUMNS];
            double moved = 0.25 * around - here[column];
            into[column] = here[column] + 0.9 * moved;
            change += moved * moved;
        }
    }
    return change;
}

__attribute__((noinline)) static void multiply(
    const float *restrict a, const float *restrict b, float *restrict product) {
    for (int row = 0; row < SIZE; row++) {
        float *into = product + row * SIZE;
        for (int column = 0; column < SIZE; column++) into[column] = 0.0f;
        for (int k = 0; k < SIZE; k++) {
            float factor = a[row * SIZE + k];
            const float *line = b + k * SIZE;
            for (int column = 0; column < SIZE; column++) into[column] += factor * line[column];
        }
    }
}

static float trace(const float *matrix) {
    float sum = 0.0f;
    for (int i = 0; i < SIZE; i++) sum += matrix[i * SIZE + i];
    return sum;
}

int main(void) {
    double *old = cells(ROWS * COLUMNS), *new = cells(ROWS * COLUMNS);
    for (int column = 0; column < COLUMNS; column++) old[column] = new[column] = 100.0;
    for (int row = 1; row < ROWS; row++) old[row * COLUMNS] = new[row * COLUMNS] = 25.0;
    int sweeps = 0;
    double change;
    do {
        change = sweep(old, new);
        double *kept = old;
        old = new;
        new = kept;
    } while (++sweeps != MOST_SWEEPS && change > 1.0);
    printf("%d sweeps, change %.6f, centre %.6f\n", sweeps, change,
           old[ROWS / 2 * COLUMNS + COLUMNS / 2]);
    for (int row = 8; row < ROWS; row += 16) {
        for (int column = 8; column < COLUMNS; column += 16)
            printf(" %8.4f", old[row * COLUMNS + column]);
        printf("\n");
    }
    float *a = (float *) cells(SIZE * SIZE), *b = (float *) cells(SIZE * SIZE),
          *product = (float *) cells(SIZE * SIZE);
    for (int i = 0; i < SIZE * SIZE; i++) {
        a[i] = (float) (i % 17) / 17.0f;
        b[i] = (float) (i % 23) / 23.0f - 0.4f;
    }
    for (int round = 0; round < 4; round++) {
        multiply(a, b, product);
        printf("trace %.3f\n", (double) trace(product));
        for (int i = 0; i < SIZE * SIZE; i++) b[i] = 0.5f * b[i] + 0.01f * product[i];
    }
    return 0;
}
