//! The source as whole numbers of quanta on the builder's own disk, at every power-of-two spacing.
//!
//! Plane j holds the samples whose coordinates are multiples of 2^j, rows from the south. A build reads
//! each source sample once (twice where the quantum has to be found first) and from then on only windows
//! of planes: the finest near the diamonds at hand, coarser ones farther out. Memory: one row buffer a
//! reader; disk: 16/3 bytes a sample, in the machine's own order of bytes.

use diamantina_protocol::NODATA;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The planes of a source.
#[derive(Debug)]
pub struct Canvas {
    planes: Vec<Plane>,
    folder: PathBuf,
}

#[derive(Debug)]
struct Plane {
    file: File,
    width: u32,
    height: u32,
}

/// Samples of one plane in a rectangle of the lattice.
#[derive(Debug)]
pub struct Window {
    spacing_log2: u32,
    /// Plane coordinates of the first sample.
    x0: u32,
    y0: u32,
    width: u32,
    heights: Vec<i32>,
}

impl Window {
    /// The height at a lattice point; the point must be a multiple of the spacing and in the window.
    #[must_use]
    pub fn at(&self, x: u32, y: u32) -> i32 {
        let (i, j) = ((x >> self.spacing_log2) - self.x0, (y >> self.spacing_log2) - self.y0);
        self.heights[j as usize * self.width as usize + i as usize]
    }

    /// The heights, row by row from the south.
    #[must_use]
    pub fn heights(&self) -> &[i32] {
        &self.heights
    }

    /// Base-2 logarithm of the spacing of the samples.
    #[must_use]
    pub fn spacing_log2(&self) -> u32 {
        self.spacing_log2
    }

    /// Lattice coordinates of the first sample.
    #[must_use]
    pub fn origin(&self) -> [u32; 2] {
        [self.x0 << self.spacing_log2, self.y0 << self.spacing_log2]
    }

    /// Samples in a row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width as usize
    }
}

impl Canvas {
    /// Planes for `width` by `height` samples, spacings 1 to 2^`coarsest`, in files that go with the
    /// folder; those that are there already are emptied. Space is taken as rows are written.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn create(folder: &Path, width: u32, height: u32, coarsest: u32) -> io::Result<Self> {
        let mut planes = Vec::new();
        for j in 0..=coarsest {
            let [width, height] = [width, height].map(|n| ((n - 1) >> j) + 1);
            let path = plane_path(folder, j);
            let file = File::options().create(true).truncate(true).read(true).write(true).open(path)?;
            file.set_len(plane_bytes(width, height))?;
            planes.push(Plane { file, width, height });
        }
        Ok(Self { planes, folder: folder.to_owned() })
    }

    /// The planes that an earlier run left; `None` if some are missing or not as long as they should be.
    ///
    /// # Errors
    /// When they cannot be opened.
    pub fn reopen(folder: &Path, width: u32, height: u32, coarsest: u32) -> io::Result<Option<Self>> {
        let mut planes = Vec::new();
        for j in 0..=coarsest {
            let [width, height] = [width, height].map(|n| ((n - 1) >> j) + 1);
            let file = match File::options().read(true).write(true).open(plane_path(folder, j)) {
                Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
                file => file?,
            };
            if file.metadata()?.len() != plane_bytes(width, height) {
                return Ok(None);
            }
            planes.push(Plane { file, width, height });
        }
        Ok(Some(Self { planes, folder: folder.to_owned() }))
    }

    /// Makes sure that the rows written so far are on the disk.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn sync(&self) -> io::Result<()> {
        self.planes.iter().try_for_each(|plane| plane.file.sync_data())
    }

    /// Where the planes lie.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes whole rows, from row `y0` northward, to every plane that has samples of them. Rows may
    /// come in any order, from any thread.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn write_rows(&self, y0: u32, heights: &[i32]) -> io::Result<()> {
        let row = self.planes[0].width as usize;
        let mut kept: Vec<i32> = Vec::new();
        for (j, plane) in self.planes.iter().enumerate() {
            let (step, wide) = (1u32 << j, 1usize << j);
            // Rows of this plane among those given lie one behind the other in its file.
            let first = y0.next_multiple_of(step);
            kept.clear();
            let of_plane = if j == 0 {
                heights
            } else {
                for line in heights.chunks_exact(row).skip((first - y0) as usize).step_by(wide) {
                    kept.extend(line.iter().step_by(wide));
                }
                &kept
            };
            if !of_plane.is_empty() {
                let offset = u64::from(first >> j) * u64::from(plane.width) * 4;
                plane.file.write_all_at(bytemuck::cast_slice(of_plane), offset)?;
            }
        }
        Ok(())
    }

    /// The samples at multiples of 2^`spacing_log2` from south-west `[x0, y0]` to north-east `[x1, y1]`,
    /// both included; beyond the source there is no data.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn read(&self, spacing_log2: u32, [x0, y0]: [u32; 2], [x1, y1]: [u32; 2]) -> io::Result<Window> {
        let plane = &self.planes[spacing_log2 as usize];
        let (i0, j0) = (x0 >> spacing_log2, y0 >> spacing_log2);
        let (i1, j1) = (x1 >> spacing_log2, y1 >> spacing_log2);
        let width = i1 - i0 + 1;
        let mut heights = vec![NODATA; width as usize * (j1 - j0 + 1) as usize];
        let inside = plane.width.saturating_sub(i0).min(width) as usize;
        for (j, row) in (j0..=j1).zip(heights.chunks_exact_mut(width as usize)) {
            if inside == 0 || j >= plane.height {
                break;
            }
            let offset = (u64::from(j) * u64::from(plane.width) + u64::from(i0)) * 4;
            plane.file.read_exact_at(bytemuck::cast_slice_mut(&mut row[..inside]), offset)?;
        }
        Ok(Window { spacing_log2, x0: i0, y0: j0, width, heights })
    }
}

fn plane_path(folder: &Path, spacing_log2: u32) -> PathBuf {
    folder.join(format!("plane-{spacing_log2}"))
}

fn plane_bytes(width: u32, height: u32) -> u64 {
    u64::from(width) * u64::from(height) * 4
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_plane_holds_the_multiples_of_its_spacing() {
        let folder = tempfile::tempdir().unwrap();
        let canvas = Canvas::create(folder.path(), 21, 13, 3).unwrap();
        let height = |x: u32, y: u32| (x * 100 + y).cast_signed();
        // In bands that do not line up with the spacings, and out of order.
        for (y0, rows) in [(5, 8), (0, 5)] {
            let band: Vec<i32> = (y0..y0 + rows).flat_map(|y| (0..21).map(move |x| height(x, y))).collect();
            canvas.write_rows(y0, &band).unwrap();
        }
        for j in 0..=3 {
            let window = canvas.read(j, [8, 0], [31, 15]).unwrap();
            for y in (0..=15).step_by(1 << j) {
                for x in (8..=31).step_by(1 << j) {
                    let expected = if x < 21 && y < 13 { height(x, y) } else { NODATA };
                    assert_eq!(window.at(x, y), expected, "plane {j} at {x}, {y}");
                }
            }
        }
    }
}
