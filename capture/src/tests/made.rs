//! Small recordings of every layout.

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, Rgb, RgbImage};
use tempfile::TempDir;

use crate::dataset::{DatasetError, Layout, OpenOptions, Recording, open, open_one};

/// Image size of the made recordings.
pub const SIZE_PX: (u32, u32) = (8, 6);

/// A folder that goes away with the test.
pub struct Folder(TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn join(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    pub fn write(&self, name: &str, text: impl AsRef<[u8]>) {
        let path = self.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    pub fn colour(&self, name: &str, level: u8) {
        self.colour_of_size(name, level, SIZE_PX);
    }

    pub fn colour_of_size(&self, name: &str, level: u8, (width, height): (u32, u32)) {
        self.write(name, "");
        RgbImage::from_pixel(width, height, Rgb([level, 2, 3])).save(self.join(name)).unwrap();
    }

    pub fn grey(&self, name: &str, level: u8) {
        self.write(name, "");
        GrayImage::from_pixel(SIZE_PX.0, SIZE_PX.1, Luma([level])).save(self.join(name)).unwrap();
    }

    pub fn open(&self, options: &OpenOptions) -> Result<Vec<Recording>, DatasetError> {
        open(self.path(), options)
    }

    pub fn open_one(&self, options: &OpenOptions) -> Result<Recording, DatasetError> {
        open_one(self.path(), options)
    }

    /// The message of the error that opening gives, without the folder's path.
    pub fn refusal(&self, options: &OpenOptions) -> String {
        let error = self.open(options).unwrap_err().to_string();
        error
            .replace(&format!("{}/", self.path().display()), "")
            .replace(&self.path().display().to_string(), "FOLDER")
    }
}

/// `world_from_camera` at x = `x`, looking along world z.
pub fn matrix_at(x: f64) -> String {
    format!("1 0 0 {x}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
}

pub fn row_at(x: f64) -> String {
    format!("1 0 0 {x} 0 1 0 0 0 0 1 0\n")
}

/// Two sequences of six frames; frame n of seq-01 stands at x = n, of seq-02 at x = 100 + n.
pub fn seven_scenes() -> Folder {
    let folder = Folder::new();
    for sequence in [1, 2] {
        for number in 0..6u8 {
            let stem = format!("seq-{sequence:02}/frame-{number:06}");
            folder.colour(&format!("{stem}.color.png"), number);
            let x = f64::from(number) + if sequence == 2 { 100.0 } else { 0.0 };
            folder.write(&format!("{stem}.pose.txt"), matrix_at(x));
            folder.write(&format!("{stem}.depth.png"), "not looked at");
        }
    }
    folder.write("TrainSplit.txt", "sequence1\n");
    folder.write("TestSplit.txt", "sequence2\n");
    folder
}

/// Sequence 03 with five grey (image_0) and five colour (image_2) frames, a tenth of a second apart.
pub fn kitti() -> Folder {
    let folder = Folder::new();
    let (mut times, mut poses) = (String::new(), String::new());
    for number in 0..5u8 {
        folder.grey(&format!("sequences/03/image_0/{number:06}.png"), number);
        folder.colour(&format!("sequences/03/image_2/{number:06}.png"), number);
        times += &format!("{:e}\n", f64::from(number) * 0.1);
        poses += &row_at(f64::from(number));
    }
    folder.write("sequences/03/times.txt", times);
    folder.write("poses/03.txt", poses);
    let projection = |baseline: f64| format!("10 0 4 {baseline} 0 10 3 0 0 0 1 0");
    let calibration: Vec<String> =
        (0..4).map(|camera| format!("P{camera}: {}", projection(-0.5 * f64::from(camera)))).collect();
    folder.write("sequences/03/calib.txt", calibration.join("\n"));
    folder
}

/// Five frames, 0.04 s apart; ground truth every 0.01 s at x = seconds, ending at 0.13 s.
pub fn tum() -> Folder {
    let folder = Folder::new();
    let (mut list, mut truth) = ("# colour images\n".to_string(), "# truth\n".to_string());
    for number in 0..5u8 {
        let name = format!("rgb/{number}.png");
        folder.colour(&name, number);
        list += &format!("{:.6} {name}\n", 1000.005 + f64::from(number) * 0.04);
    }
    for step in 0..14 {
        let t = f64::from(step) * 0.01;
        truth += &format!("{:.4} {t:.4} 0 0 0 0 0 1\n", 1000.0 + t);
    }
    folder.write("rgb.txt", list);
    folder.write("groundtruth.txt", truth);
    folder
}

/// Four frames 50 ms apart of cam0 and cam1; the body moves along x by 1 a frame, cam0 sits 0.5 above it.
pub fn euroc() -> Folder {
    let folder = Folder::new();
    let stamp = |number: u64| 1_403_636_579_000_000_000 + number * 50_000_000;
    for camera in ["cam0", "cam1"] {
        let mut list = "#timestamp [ns],filename\n".to_string();
        for number in 0..4u8 {
            let name = format!("{}.png", stamp(number.into()));
            folder.grey(&format!("mav0/{camera}/data/{name}"), number);
            list += &format!("{},{name}\n", stamp(number.into()));
        }
        folder.write(&format!("mav0/{camera}/data.csv"), list);
    }
    folder.write(
        "mav0/cam0/sensor.yaml",
        "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1]\nresolution: [8, 6]\n\
         intrinsics: [10, 11, 4, 3]\ndistortion_model: equidistant\ndistortion_coefficients: [1, 2, 3, 4]\n",
    );
    let truth: String = (0..4).map(|n| format!("{}, {n}, 0, 0, 1, 0, 0, 0, 9, 9, 9\n", stamp(n))).collect();
    folder.write("mav0/state_groundtruth_estimate0/data.csv", truth);
    folder
}

/// Three images in natural order of their names, looking from x = 2, 9, 10.
pub fn colmap() -> Folder {
    let folder = Folder::new();
    let mut list = "# images\n".to_string();
    for number in [10u8, 2, 9] {
        folder.colour(&format!("images/im {number}.png"), number);
        list += &format!("{number} 1 0 0 0 -{number} 0 0 1 im {number}.png\n1 2 3\n");
    }
    folder.write("sparse/0/cameras.txt", "1 SIMPLE_RADIAL 8 6 10 4 3 0.1\n");
    folder.write("sparse/0/images.txt", list);
    folder
}

/// Twelve images, `0.png` to `11.png`.
pub fn images() -> Folder {
    let folder = Folder::new();
    for number in 0..12u8 {
        folder.colour(&format!("{number}.png"), number);
    }
    folder.write("notes.txt", "no image");
    folder.write(".hidden.png", "not looked at");
    folder
}

/// Every layout with its recording.
pub fn all() -> Vec<(Layout, Folder)> {
    vec![
        (Layout::SevenScenes, seven_scenes()),
        (Layout::Kitti, kitti()),
        (Layout::Tum, tum()),
        (Layout::Euroc, euroc()),
        (Layout::Colmap, colmap()),
        (Layout::Images, images()),
    ]
}
