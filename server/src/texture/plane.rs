//! The texels of a level on disk: rows from the south, 4 bytes each. The file vanishes with its handle.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

pub(super) struct Plane {
    file: File,
    size: [u32; 2],
}

impl Plane {
    /// One of such a size, all transparent, in a folder.
    pub(super) fn new(folder: &Path, size: [u32; 2]) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        let plane = Self { file, size };
        plane.file.set_len(plane.place(0, size[1]))?;
        Ok(plane)
    }

    fn place(&self, x: u32, y: u32) -> u64 {
        4 * (u64::from(y) * u64::from(self.size[0]) + u64::from(x))
    }

    /// Texels of a window, row by row; transparent beyond the plane. `out` is replaced.
    pub(super) fn read(
        &self,
        [x0, y0]: [i64; 2],
        [width, height]: [u32; 2],
        out: &mut Vec<[u8; 4]>,
    ) -> io::Result<()> {
        out.clear();
        out.resize(width as usize * height as usize, [0; 4]);
        let clip = |from: i64, size: u32, all: u32| {
            let [start, end] = [from, from + i64::from(size)].map(|at| at.clamp(0, all.into()));
            u32::try_from(start).ok().zip(u32::try_from(end).ok())
        };
        let (Some((x, x_end)), Some((y, y_end))) =
            (clip(x0, width, self.size[0]), clip(y0, height, self.size[1]))
        else {
            return Ok(());
        };
        let columns = (x_end - x) as usize;
        for y in (y..y_end).filter(|_| columns > 0) {
            let (left, below) = (i64::from(x) - x0, i64::from(y) - y0);
            let start = usize::try_from(below * i64::from(width) + left).unwrap_or(0);
            let texels = out[start..start + columns].as_flattened_mut();
            self.file.read_exact_at(texels, self.place(x, y))?;
        }
        Ok(())
    }

    /// Writes a rectangle, row by row.
    pub(super) fn write(
        &self,
        [x, y]: [u32; 2],
        [width, height]: [usize; 2],
        texels: &[[u8; 4]],
    ) -> io::Result<()> {
        debug_assert_eq!(texels.len(), width * height);
        for (y, row) in (y..).zip(texels.chunks_exact(width.max(1))) {
            self.file.write_all_at(row.as_flattened(), self.place(x, y))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_possible_wrap,
        clippy::cast_sign_loss,
        reason = "small numbers"
    )]
    fn what_is_written_is_read_and_nothing_beyond() {
        let folder = tempfile::tempdir().unwrap();
        let plane = Plane::new(folder.path(), [5, 3]).unwrap();
        let texel = |x: usize, y: usize| [x as u8, y as u8, 9, 255];
        let texels: Vec<_> = (0..2).flat_map(|y| (0..3).map(move |x| texel(x + 1, y + 1))).collect();
        plane.write([1, 1], [3, 2], &texels).unwrap();
        let mut out = Vec::new();
        plane.read([-2, -1], [9, 6], &mut out).unwrap();
        for (i, found) in out.iter().enumerate() {
            let (x, y) = (i as i64 % 9 - 2, i as i64 / 9 - 1);
            let is_written = (1..4).contains(&x) && (1..3).contains(&y);
            assert_eq!(*found, if is_written { texel(x as usize, y as usize) } else { [0; 4] }, "{x} {y}");
        }
    }
}
